//! Runs the whole controller against a peer that says anything, in any order, by any clock, and judges every action on the wire.
//!
//! The controller, its policy and the shared-memory link are the real ones, as is the swap of bundles; only the peer is ours, and the
//! clock. Time is the harness's own: it passes where the controller waits or looks at its clock, and all of it is decided by the seed. So
//! real time costs no time, and what was found is found again. Whatever must not happen is printed with the seed, the number of the
//! message, and the command that shows it again with as few messages as were found to do.

mod asking;
mod bundles;
mod draft;
mod judge;
mod report;
mod run;
mod scenario;
mod shorten;
mod wire;
mod world;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::sync::{Mutex, PoisonError};

use anyhow::Context;
use clap::Parser;
use rcwm_models::wire::LinkSettings;
use rcwm_tests::{Domain, campaign};

use bundles::Bundles;
use judge::Violation;
use report::{Finding, Report};
use run::Outcome;
use scenario::Scenario;

/// Runs the whole controller against a hostile peer.
#[derive(Debug, Clone, Parser)]
#[command(
    name = "hostile-peer",
    after_help = "Examples:\n  \
    hostile-peer --messages 1000000 --json hostile.json\n  \
    hostile-peer --seed 4711 --keep 0-3,17     shows a finding again, with these of the peer's deeds\n\n\
    Run number i has seed SEED + i: a campaign that was stopped goes on with --seed NEXT, which it prints.\n\
    Exits 0 if there was no finding, else 1."
)]
struct Arguments {
    /// The bundle that is run, as it is and in variants
    #[arg(long, value_name = "DIR", default_value = "models/bundles/untrained")]
    bundle: PathBuf,
    /// Messages in all, at least
    #[arg(long, value_name = "N", default_value_t = 20_000)]
    messages: u64,
    /// Seed of the first run
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    seed: u64,
    /// Messages of one run, at most
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..))]
    length: u32,
    /// Runs at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=64))]
    workers: u8,
    /// Makes every run twice, and compares the actions
    #[arg(long)]
    twice: bool,
    /// Only the run of --seed, with only these of the peer's deeds
    #[arg(long, value_name = "NUMBERS")]
    keep: Option<String>,
    /// Does not tell findings of this kind, so that others come to light behind them
    #[arg(long, value_name = "KIND")]
    ignore: Vec<String>,
    /// Ends after so many findings
    #[arg(long, value_name = "N", default_value_t = 50)]
    findings_max: usize,
    /// Writes the report to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done = match &arguments.keep {
        Some(numbers) => replay(&arguments, numbers),
        None => run_seeds(&arguments),
    };
    campaign::exit(done)
}

/// What every run needs.
struct Ground<'a> {
    bundles: &'a Bundles,
    link: LinkSettings,
    length: usize,
    twice: bool,
    ignored: &'a [String],
}

impl Ground<'_> {
    fn scenario(&self, seed: u64) -> Scenario {
        Scenario::of(seed, self.length, self.bundles.all.len())
    }

    fn run(&self, seed: u64, scenario: &Scenario, keep: &dyn Fn(usize) -> bool) -> anyhow::Result<Outcome> {
        let mut outcome = run::run(seed, scenario, keep, self.bundles, &self.link, self.ignored)?;
        if self.twice && outcome.violation.is_none() {
            let again = run::run(seed, scenario, keep, self.bundles, &self.link, self.ignored)?;
            if again.digest != outcome.digest {
                let text = format!("{:?} and {:?} actions", outcome.sent, again.sent);
                let violation = Violation { kind: "not the same again", text };
                outcome.violation = Some((violation, scenario.steps.len() - 1, outcome.messages));
            }
        }
        Ok(outcome)
    }

    /// The finding of a run, if it has one; `is_new` says whether it is worth to be shortened.
    fn finding(&self, seed: u64, scenario: &Scenario, outcome: &Outcome, is_new: bool) -> Option<Finding> {
        let (violation, step, message) = outcome.violation.clone()?;
        let mut kept: Vec<usize> = (0..=step).collect();
        let shows = |kept: &[usize]| {
            let keep = |at: usize| kept.binary_search(&at).is_ok();
            let found = self.run(seed, scenario, &keep).ok().and_then(|outcome| outcome.violation);
            found.is_some_and(|(found, ..)| found.kind == violation.kind)
        };
        if is_new {
            kept = shorten::shorten(kept, shows);
        }
        let setup = format!("{:?}", scenario.setup);
        let kept_text = shorten::text_of(&kept);
        let ignored: String = self.ignored.iter().map(|kind| format!(" --ignore {kind:?}")).collect();
        let length = self.length;
        let command = format!("hostile-peer --seed {seed} --length {length}{ignored} --keep {kept_text}");
        Some(Finding {
            seed,
            message,
            kind: violation.kind,
            text: violation.text,
            setup,
            kept: kept.len(),
            command,
        })
    }
}

/// One run with some of its deeds, told in full.
fn replay(arguments: &Arguments, numbers: &str) -> anyhow::Result<bool> {
    run::keep_panics();
    let numbers = shorten::numbers_of(numbers).map_err(anyhow::Error::msg)?;
    let bundles = Bundles::make(&arguments.bundle)?;
    let domain = Domain::new();
    let ground = Ground {
        bundles: &bundles,
        link: domain.link("hostile"),
        length: arguments.length as usize,
        twice: arguments.twice,
        ignored: &arguments.ignore,
    };
    let scenario = ground.scenario(arguments.seed);
    println!("bundle {}, {:?}", bundles.to_start(scenario.setup.bundle).0.name, scenario.setup);
    for number in &numbers {
        if let Some(step) = scenario.steps.get(*number) {
            println!("{number}: {step:?}");
        }
    }
    let outcome = ground.run(arguments.seed, &scenario, &|at| numbers.contains(&at))?;
    println!("{outcome:?}");
    Ok(outcome.violation.is_none())
}

/// Run after run; true without a finding.
fn run_seeds(arguments: &Arguments) -> anyhow::Result<bool> {
    let stop = campaign::stop_on_ctrl_c()?;
    run::keep_panics();
    let bundles = Bundles::make(&arguments.bundle)?;
    let bar =
        campaign::bar(arguments.messages, "{wide_bar} {pos}/{len} messages {elapsed} eta {eta}", "messages")?;
    let shared = Mutex::new(Report::new(arguments));
    let work = || -> anyhow::Result<()> {
        let domain = Domain::new();
        let ground = Ground {
            bundles: &bundles,
            link: domain.link("hostile"),
            length: arguments.length as usize,
            twice: arguments.twice,
            ignored: &arguments.ignore,
        };
        loop {
            let taken = shared.lock().unwrap_or_else(PoisonError::into_inner).next_seed();
            let Some(seed) = taken.filter(|_| !stop.load(Ordering::Relaxed)) else { break };
            let scenario = ground.scenario(seed);
            let outcome = ground.run(seed, &scenario, &|_| true).with_context(|| format!("seed {seed}"))?;
            let is_new = shared.lock().unwrap_or_else(PoisonError::into_inner).note(&scenario, &outcome);
            if let Some(finding) = ground.finding(seed, &scenario, &outcome, is_new) {
                bar.suspend(|| print!("{}", finding.lines(is_new)));
                shared.lock().unwrap_or_else(PoisonError::into_inner).findings.push(finding);
            }
            bar.inc(outcome.messages);
        }
        let left = domain.leftovers();
        anyhow::ensure!(left.is_empty(), "left in shared memory: {left:?}");
        Ok(())
    };
    campaign::on_threads(arguments.workers.into(), work)?;
    bar.finish_and_clear();
    let report = shared.into_inner().unwrap_or_else(PoisonError::into_inner);
    print!("{}", report.text());
    campaign::write_json(arguments.json.as_deref(), &report)?;
    Ok(report.findings.is_empty())
}
