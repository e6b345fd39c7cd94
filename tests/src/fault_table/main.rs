//! The table of faults in `docs/controller.md`: every fault many times, judged on the wire.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::Context;
use clap::{Parser, Subcommand};
use rcwm_models::wire::LinkSettings;
use rcwm_tests::faults::{Experiment, Fault, Outcome, serve};
use serde::Serialize;

/// Breaks things on purpose, many times, and measures what the controller does about it
#[derive(Debug, Parser)]
#[command(
    name = "fault-table",
    after_help = "Examples:\n  cargo build --release --workspace --bins\n  target/release/fault-table --rounds 50 --json faults.json\n  target/release/fault-table --only dropped --only delayed"
)]
struct Arguments {
    #[command(subcommand)]
    verb: Option<Verb>,
    /// How often each fault happens
    #[arg(long, value_name = "N", default_value_t = 50)]
    rounds: usize,
    /// Rate of the recorded stream, in Hz
    #[arg(long, value_name = "HZ", default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..=1000))]
    rate_hz: u32,
    /// Only these faults, by their names in the table
    #[arg(long, value_name = "FAULT")]
    only: Vec<String>,
    /// Writes everything that was measured to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// The robot on a fixed clock that the experiments kill and stop
    #[command(hide = true)]
    Peer {
        #[arg(long)]
        instance: String,
        #[arg(long)]
        period_us: u64,
    },
}

#[derive(Serialize)]
struct Report {
    rate_hz: u32,
    outcomes: Vec<Outcome>,
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    if let Some(Verb::Peer { instance, period_us }) = &arguments.verb {
        let period = Duration::from_micros(*period_us);
        serve(LinkSettings::new(instance), period, Fault::None, usize::MAX, &AtomicBool::new(false))?;
        return Ok(());
    }
    let period = Duration::from_secs(1) / arguments.rate_hz;
    let wanted = |fault: &Experiment| arguments.only.is_empty() || arguments.only.contains(&name(*fault));
    let experiments: Vec<Experiment> = Experiment::ALL.into_iter().filter(wanted).collect();
    if experiments.is_empty() {
        let names = Experiment::ALL.map(name).join(", ");
        anyhow::bail!("--only {}: no such fault; there are {names}", arguments.only.join(" --only "));
    }
    let bar = indicatif::ProgressBar::new(experiments.len() as u64);
    rcwm_models::outln!("{HEADER}");
    let mut outcomes = Vec::new();
    for experiment in experiments {
        let outcome = experiment.run(arguments.rounds, period);
        bar.suspend(|| rcwm_models::outln!("{}", row(&outcome)));
        bar.inc(1);
        outcomes.push(outcome);
    }
    bar.finish_and_clear();
    if let Some(path) = &arguments.json {
        let report = Report { rate_hz: arguments.rate_hz, outcomes };
        let text = serde_json::to_vec_pretty(&report).context("writing JSON")?;
        rcwm_models::files::write_atomic(path, &text)?;
    }
    Ok(())
}

const HEADER: &str = "\
| fault | times | stand-in after, periods | fallback after, periods | policy back after, ms | actions | imagined | fallback | stale | invalid | left |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |";

/// The name in the table and on the command line.
fn name(experiment: Experiment) -> String {
    let name = serde_json::to_value(experiment).ok();
    name.as_ref().and_then(|name| name.as_str()).unwrap_or("?").replace('_', "-")
}

fn row(outcome: &Outcome) -> String {
    let verdict = &outcome.verdict;
    format!(
        "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        name(outcome.experiment),
        outcome.rounds,
        spread(&outcome.stand_in_periods),
        spread(&outcome.fallback_periods),
        spread(&outcome.back_ms),
        verdict.actions,
        verdict.sources[1],
        verdict.sources[2],
        verdict.stale.len(),
        verdict.invalid,
        outcome.leftovers.len(),
    )
}

/// Median and largest.
fn spread(values: &[f64]) -> String {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.last() {
        Some(max) => format!("{:.2} (max {max:.2})", sorted[sorted.len() / 2]),
        None => "-".into(),
    }
}
