//! Exchanges policies under a running controller, again and again, while a stream of recorded images comes at a fixed rate, and counts
//! what was answered late.
//!
//! The stream is first played without any swap, for the same machine under the same load; then bundles are swapped in turn, at once and
//! at an episode's start, with bad bundles in between that must be refused.

mod bad;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Parser;
use rcwm_models::bundle::Bundle;
use rcwm_models::wire::{Format, LinkSettings, SimulatorLink, forget_prefix, list_leftovers};
use rcwm_runtime::swap::{Answer, When, ask};
use rcwm_tests::campaign;
use rcwm_tests::stream::{PhaseReport, Stream};
use serde::Serialize;

use bad::BadBundles;

/// The stream's phase without swaps, and the one with them.
const PHASES: [&str; 2] = ["without swaps", "with swaps"];
/// Every so many swaps a bad bundle is tried first.
const BAD_EVERY: u32 = 4;

/// Exchanges policies under load and counts what was answered late.
#[derive(Debug, Parser)]
#[command(
    name = "swap-under-load",
    after_help = "Examples:\n  \
    swap-under-load --bundle models/bundles/untrained --swaps 100 --json swap.json\n  \
    swap-under-load --bundle A --other B --rate-hz 100 -- --spin-us 200\n\n\
    What follows -- goes to `rcwm-runtime run`. Exits 0 if every good bundle was taken and every bad one refused."
)]
struct Arguments {
    /// The bundle the run starts with
    #[arg(long, value_name = "DIR", default_value = "models/bundles/untrained")]
    bundle: PathBuf,
    /// The bundle it is exchanged with, in turn; the same one where none is given
    #[arg(long, value_name = "DIR")]
    other: Option<PathBuf>,
    /// Number of swaps
    #[arg(long, value_name = "N", default_value_t = 100)]
    swaps: u32,
    /// Observations a second
    #[arg(long, value_name = "HZ", default_value_t = 40.0)]
    rate_hz: f64,
    /// Observations of an episode
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(2..))]
    episode: u32,
    /// Length of the phase without swaps, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 20.0)]
    quiet_s: f64,
    /// Writes the report to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Goes to `rcwm-runtime run`
    #[arg(last = true)]
    run: Vec<String>,
}

#[derive(Debug, Default, Serialize)]
struct Swaps {
    /// Good bundles that were taken.
    taken: u32,
    /// Bad bundles that were refused.
    refused: u32,
    /// What should have been taken and was not, or taken and should not have been.
    wrong: Vec<String>,
    /// Longest time to load, verify and warm up, in s.
    prepared_s_max: f64,
    /// What was said to bad bundles.
    refusals: Vec<String>,
}

#[derive(Debug, Serialize)]
struct Report {
    rate_hz: f64,
    phases: Vec<PhaseReport>,
    swaps: Swaps,
    /// The run's own summary.
    run: serde_json::Value,
    /// What was left in shared memory.
    leftovers: Vec<String>,
}

fn main() -> ExitCode {
    campaign::exit(run(&Arguments::parse()))
}

fn run(arguments: &Arguments) -> anyhow::Result<bool> {
    let stop = campaign::stop_on_ctrl_c()?;
    let prefix = format!("rcwm_load{}_", std::process::id());
    let link = LinkSettings { prefix: Some(prefix.clone()), ..LinkSettings::new("swap") };
    let folder = tempfile::tempdir()?;
    let summary = folder.path().join("run.json");
    let bundle = Bundle::open(&arguments.bundle)?;
    let peer = SimulatorLink::open(link.clone(), &Format::metaworld())?;
    let mut stream = Stream::new(&peer, &bundle, arguments.rate_hz, arguments.episode)?;
    let mut controller = Running(start_run(arguments, &link, &summary)?);
    stream.wait_for_controller(&stop)?;
    let (phase, done) = (AtomicUsize::new(0), AtomicBool::new(false));
    let (phases, swaps) = std::thread::scope(|scope| {
        let asker = scope.spawn(|| {
            let swaps = exchange(arguments, &link, folder.path(), &phase, &stop);
            done.store(true, Ordering::Relaxed);
            swaps
        });
        let phases = stream.play(&PHASES, &phase, &done);
        (phases, asker.join())
    });
    let swaps = swaps.map_err(|_| anyhow::anyhow!("the thread that asks panicked"))??;
    let phases = phases?;
    peer.close()?;
    controller.0.wait().context("waiting for the run")?;
    let run = serde_json::from_slice(&std::fs::read(&summary).context("the run's summary")?)?;
    let leftovers = list_leftovers(&prefix)?;
    forget_prefix(&prefix);
    let report = Report { rate_hz: arguments.rate_hz, phases, swaps, run, leftovers };
    rcwm_models::out!("{}", report.text());
    campaign::write_json(arguments.json.as_deref(), &report)?;
    Ok(report.swaps.wrong.is_empty() && report.swaps.taken == arguments.swaps)
}

/// The run, killed where it still runs when this is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It has ended already in all but a failed run.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start_run(arguments: &Arguments, link: &LinkSettings, summary: &Path) -> anyhow::Result<Child> {
    let program = std::env::current_exe().context("own program")?.with_file_name("rcwm-runtime");
    let mut command = Command::new(&program);
    command.args(["run", "--instance", &link.instance, "--bundle"]).arg(&arguments.bundle);
    command.arg("--json").arg(summary).args(&arguments.run);
    command.env("RCWM_PREFIX", link.prefix.as_deref().unwrap_or_default());
    command.stdin(Stdio::null()).stdout(Stdio::null());
    command.spawn().with_context(|| format!("{}: build it first", program.display()))
}

/// Asks for one swap after another, beside the stream.
fn exchange(
    arguments: &Arguments,
    link: &LinkSettings,
    folder: &Path,
    phase: &AtomicUsize,
    stop: &AtomicBool,
) -> anyhow::Result<Swaps> {
    let bad = BadBundles::make(&arguments.bundle, folder)?;
    let quiet = Instant::now();
    while quiet.elapsed().as_secs_f64() < arguments.quiet_s && !stop.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(20));
    }
    phase.store(1, Ordering::Relaxed);
    let mut swaps = Swaps::default();
    let bar = indicatif::ProgressBar::new(u64::from(arguments.swaps)).with_message("swaps");
    for round in 0..arguments.swaps {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        if round % BAD_EVERY == 0 {
            let (name, bundle) = bad.of_round(round / BAD_EVERY);
            swaps.note_bad(name, ask(link, bundle, When::Now, None, stop, &mut |_| {})?);
        }
        let other = arguments.other.as_ref().filter(|_| round % 2 == 0).unwrap_or(&arguments.bundle);
        let when = if round % 2 == 0 { When::Now } else { When::Episode };
        let mut prepared = 0.0;
        let answer = ask(link, other, when, None, stop, &mut |answer| {
            if let Answer::Ready { prepared_s } = answer {
                prepared = *prepared_s;
            }
        })?;
        swaps.prepared_s_max = swaps.prepared_s_max.max(prepared);
        match answer {
            Answer::Taken { .. } => swaps.taken += 1,
            other => swaps.wrong.push(format!("round {round}: {other:?}")),
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(swaps)
}

impl Swaps {
    fn note_bad(&mut self, name: &str, answer: Answer) {
        match answer {
            Answer::Refused { reason } => {
                self.refused += 1;
                let line = format!("{name}: {reason}");
                if !self.refusals.contains(&line) {
                    self.refusals.push(line);
                }
            }
            other => self.wrong.push(format!("{name}: {other:?}")),
        }
    }
}

impl Report {
    fn text(&self) -> String {
        let mut text: String = self.phases.iter().map(PhaseReport::text).collect();
        let Swaps { taken, refused, wrong, prepared_s_max, refusals } = &self.swaps;
        text += &format!("swaps      {taken} taken, {refused} bad bundles refused, {} wrong", wrong.len());
        text += &format!("; ready after at most {prepared_s_max:.2} s\n");
        for line in wrong {
            text += &format!("  wrong    {line}\n");
        }
        for line in refusals {
            text += &format!("  refused  {line}\n");
        }
        let counters = &self.run["counters"];
        text += &format!(
            "run        swaps {}, missed deadlines {} ({} of them published late), missed observations {}, fallback answers {}\n",
            counters["swaps"],
            counters["missed_deadlines"],
            counters["missed_deadlines_published_late"],
            counters["missed_observations"],
            counters["fallback_answers"]
        );
        text + &format!("left       {:?} in shared memory\n", self.leftovers)
    }
}
