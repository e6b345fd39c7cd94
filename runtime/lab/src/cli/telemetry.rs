//! `rcwm-lab telemetry`.

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use clap::Args;
use rcwm_runtime::cli::shared;

use crate::log::LoggedLatencies;
use crate::plot::write_latencies;
use rcwm_runtime::log::LogReader;
use rcwm_runtime::telemetry::LatencyFiles;

/// Arguments of `telemetry`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-runtime run --bundle models/bundles/hammer --instance demo --log runs/demo.rcwmlog\n  \
    rcwm-lab telemetry --log runs/demo.rcwmlog --hgrm runs/hgrm --plot runs/latency.png\n\n\
    A run writes the same files with its own --hgrm and --plot, and snapshots while it goes on with --telemetry.")]
pub(super) struct TelemetryArguments {
    /// The log
    #[arg(long, value_name = "FILE")]
    log: PathBuf,
    #[command(flatten)]
    files: LatencyFiles,
    /// Writes everything to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn run(arguments: &TelemetryArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    arguments.files.prepare()?;
    let stop = shared::stop_flag()?;
    let mut log = LogReader::open(&arguments.log)?;
    let bar = shared::progress_bar(0, "reading", "bytes");
    let latencies = LoggedLatencies::read(&mut log, &mut |(read, bytes)| {
        bar.set_length(bytes);
        bar.set_position(read);
        !stop.load(Ordering::Relaxed)
    })?;
    bar.finish_and_clear();
    let header = log.header();
    let title = format!(
        "{} bundle for {}, engine {}: {} logged ticks",
        header.bundle.preset, header.bundle.task, header.engine.kind, latencies.report.ticks
    );
    write_latencies(&arguments.files, &latencies.telemetry, &title, latencies.report.period_us)?;
    shared::write_json(arguments.json.as_deref(), &latencies.report)?;
    rcwm_models::out!("{}", latencies.text());
    rcwm_models::out!("{}", arguments.files.lines());
    match latencies.report.log_damage {
        Some(damage) => anyhow::bail!(damage),
        None => Ok(()),
    }
}
