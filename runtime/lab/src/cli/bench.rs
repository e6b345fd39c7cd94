//! `rcwm-lab bench`.

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use clap::Args;
use rcwm_models::bundle::BundleKind;
use rcwm_runtime::cli::shared::{self, EngineChoice};
use rcwm_runtime::realtime::Request;
use rcwm_runtime::telemetry::LatencyFiles;

/// Arguments of `bench`.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rcwm-lab bench --bundle models/bundles/hammer --engine all --ticks 2000 --json b.json"
)]
pub(super) struct BenchArguments {
    /// The bundle's folder
    #[arg(long, value_name = "DIR")]
    bundle: PathBuf,
    /// Engine; tract runs as deployed and on one thread; ONNX Runtime, with one and with two threads, the exported parts in a row and, worked
    /// ahead as ours is, two graphs cut where the image comes in
    #[arg(long, value_enum, default_value = "all")]
    engine: EngineChoice,
    /// Measured ticks of each engine
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    ticks: u64,
    /// Measures tract from the exported parts to what is deployed, one optimisation at a time, in place of the engines
    #[arg(long, alias = "ladder", conflicts_with = "engine")]
    ablation: bool,
    /// Measures with SCHED_FIFO of this priority and locked memory, as `run --realtime` does
    #[arg(long, value_name = "PRIORITY", num_args = 0..=1, default_missing_value = "50",
        value_parser = clap::value_parser!(u8).range(1..=99))]
    realtime: Option<u8>,
    #[command(flatten)]
    files: LatencyFiles,
    /// Writes everything to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn run(arguments: &BenchArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    arguments.files.prepare()?;
    let bundle = shared::open_bundle(&arguments.bundle)?;
    let (kinds, left_out) = arguments.engine.engines()?;
    let mut cases = crate::bench::engines(&kinds, bundle.manifest.model.is_some());
    if arguments.ablation {
        if bundle.manifest.kind == BundleKind::Recurrent {
            anyhow::bail!(
                "--ablation: a policy of kind recurrent runs as it is, there is nothing to leave out"
            );
        }
        cases = crate::bench::ablation();
    }
    let stop = shared::stop_flag()?;
    let ticks = arguments.ticks as usize;
    let real_time = arguments.realtime.map(|priority| Request { priority: Some(priority), cpu: None });
    let bar = shared::progress_bar(ticks + ticks / 10, "measuring", "ticks");
    let mut rounds: u64 = 0;
    let measured = crate::bench::bench(&bundle, &cases, ticks, real_time, &mut || {
        rounds += 1;
        // Drawing costs time that would disturb the next tick.
        if rounds.is_multiple_of(50) {
            bar.set_position(rounds);
        }
        !stop.load(Ordering::Relaxed)
    })?;
    bar.finish_and_clear();
    let report = &measured.report;
    measured.write(&arguments.files)?;
    shared::write_json(arguments.json.as_deref(), report)?;
    rcwm_models::out!("{}", if arguments.ablation { report.steps_text() } else { report.text() });
    if let Some(reason) = left_out {
        rcwm_models::outln!("engine ort not measured: {reason}");
    }
    rcwm_models::out!("{}", arguments.files.lines());
    Ok(())
}
