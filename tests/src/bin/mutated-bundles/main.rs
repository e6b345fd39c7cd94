//! Loads thousands of damaged bundles as the runtime does and proves that none makes it panic, hang or ask for much memory.
//!
//! Every case is made from its seed: bit flips, truncations and grafts of the files' bytes, changes of the manifest's text, and
//! changes of graph, shapes and attributes behind a repaired checksum, so that parsers and engine see the damage; and files that are
//! small for what they make a reader do. A case is
//! worked on in a child process whose memory is limited by the kernel, and watched by the parent; a child that dies, is stopped
//! or grows is a finding, printed with the seed that makes the same case again.

mod bomb;
mod bundle;
mod case;
mod child;
mod graph;
mod report;
mod worker;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::sync::{Mutex, PoisonError};

use clap::Parser;
use rcwm_tests::campaign;

use child::Child;
use report::Report;

/// Damages a bundle in many ways and loads each as the runtime does.
#[derive(Debug, Clone, Parser)]
#[command(
    name = "mutated-bundles",
    after_help = "Examples:\n  \
    mutated-bundles --count 100000 --json mutated.json\n  \
    mutated-bundles --seed 4711 --count 1 --keep /tmp/case     makes one case again, and keeps its files\n\n\
    Case number i has seed SEED + i: a run that was stopped goes on with --seed NEXT, which it prints.\n\
    Exits 0 if there was no finding, else 1."
)]
struct Arguments {
    /// The bundle that is damaged
    #[arg(long, value_name = "DIR", default_value = "models/bundles/untrained")]
    bundle: PathBuf,
    /// Number of cases
    #[arg(long, value_name = "N", default_value_t = 1000)]
    count: u64,
    /// Seed of the first case
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    seed: u64,
    /// Child processes at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=64))]
    workers: u8,
    /// Memory a child may have, in MiB: writable memory, touched or not
    #[arg(long, value_name = "MIB", default_value_t = 256, value_parser = clap::value_parser!(u64).range(16..=65536))]
    memory_mib: u64,
    /// Processor time a case may take, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0)]
    cpu_s_max: f64,
    /// Time after which a case counts as hung and its child is killed, in seconds; longer, as the machine may be busy
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    wall_s_max: f64,
    /// Keeps the files of the last case in this folder
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Writes the report to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Works on cases whose seeds come on standard input
    #[arg(long, hide = true)]
    worker: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done =
        if arguments.worker { worker::serve(&arguments).map(|()| true) } else { supervise(&arguments) };
    campaign::exit(done)
}

/// Hands out seeds to children; true without a finding.
fn supervise(arguments: &Arguments) -> anyhow::Result<bool> {
    let stop = campaign::stop_on_ctrl_c()?;
    let bar = campaign::bar(arguments.count, "{msg} {wide_bar} {pos}/{len} {elapsed} eta {eta}", "bundles")?;
    let shared = Mutex::new(Report::new(arguments));
    let work = || -> anyhow::Result<()> {
        let mut child = Child::start(arguments)?;
        loop {
            let taken = shared.lock().unwrap_or_else(PoisonError::into_inner).next_seed();
            let Some(seed) = taken.filter(|_| !stop.load(Ordering::Relaxed)) else { return Ok(()) };
            let ended = child.work_on(seed, arguments)?;
            if let Some(line) = shared.lock().unwrap_or_else(PoisonError::into_inner).note(seed, &ended) {
                bar.suspend(|| rcwm_models::outln!("{line}"));
            }
            bar.inc(1);
        }
    };
    campaign::on_threads(arguments.workers.into(), work)?;
    bar.finish_and_clear();
    let report = shared.into_inner().unwrap_or_else(PoisonError::into_inner);
    rcwm_models::out!("{}", report.text());
    campaign::write_json(arguments.json.as_deref(), &report)?;
    Ok(report.findings.is_empty())
}
