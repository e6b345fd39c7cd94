//! `rcwm-lab replay`.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clap::Args;
use rcwm_runtime::cli::shared;
use serde::Serialize;

use crate::log::{ReplayReport, Replayer, WrittenEpisodes, write_episodes};
use crate::plot::write_latencies;
use rcwm_runtime::engine::{EngineKind, EngineSettings};
use rcwm_runtime::log::{BundleIdentity, LogReader};
use rcwm_runtime::telemetry::LatencyFiles;

/// Arguments of `replay`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-runtime run --bundle models/bundles/hammer --instance demo --log runs/demo.rcwmlog\n  \
    rcwm-lab replay --log runs/demo.rcwmlog --bundle models/bundles/hammer --json replay.json\n  \
    rcwm-lab replay --log runs/demo.rcwmlog --episodes data\n\n\
    Every call of the policy is made again on the logged inputs, with the logged engine, sampling and seed. Actions, surprise and\n\
    the digest of the state must be the same bit for bit; the first difference is an error. Another engine or another\n\
    processor may round otherwise. A log that was cut is replayed up to the cut.")]
pub(super) struct ReplayArguments {
    /// The log
    #[arg(long, value_name = "FILE")]
    log: PathBuf,
    /// The bundle's folder; again for each bundle that took over while the run went on
    #[arg(long, value_name = "DIR", required_unless_present = "episodes")]
    bundle: Vec<PathBuf>,
    /// Engine; the log's own unless given
    #[arg(long, value_enum, requires = "bundle")]
    engine: Option<EngineKind>,
    /// Writes the logged episodes into this folder as Dreamer's .npz files, one sub-folder a task
    #[arg(long, value_name = "DIR")]
    episodes: Option<PathBuf>,
    #[command(flatten)]
    latency_files: LatencyFiles,
    /// Writes everything to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report {
    #[serde(flatten)]
    replay: Option<ReplayReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    episodes: Option<WrittenEpisodes>,
}

pub(super) fn run(arguments: &ReplayArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    let LatencyFiles { hgrm, plot } = &arguments.latency_files;
    if arguments.bundle.is_empty() && (hgrm.is_some() || plot.is_some()) {
        anyhow::bail!("--hgrm and --plot are of a replay: add --bundle, or use `rcwm-lab telemetry`");
    }
    arguments.latency_files.prepare()?;
    let stop = shared::stop_flag()?;
    let replay = if arguments.bundle.is_empty() { None } else { Some(replay(arguments, &stop)?) };
    let episodes = match &arguments.episodes {
        Some(folder) if !stop.load(Ordering::Relaxed) => Some(write(arguments, folder, &stop)?),
        _ => None,
    };
    let damage = replay.as_ref().and_then(|report| report.log_damage.clone());
    let damage = damage.or_else(|| episodes.as_ref().and_then(|written| written.log_damage.clone()));
    let difference = replay.as_ref().and_then(|report| report.first_difference.clone());
    let report = Report { replay, episodes };
    shared::write_json(arguments.json.as_deref(), &report)?;
    if let Some(report) = &report.replay {
        rcwm_models::out!("{}", report.text());
    }
    if let Some(written) = &report.episodes {
        rcwm_models::out!("{}", episode_lines(written));
    }
    match (difference, damage) {
        (Some(difference), _) => anyhow::bail!("the replay differs first at {difference}"),
        (None, Some(damage)) => anyhow::bail!(damage),
        (None, None) => Ok(()),
    }
}

fn replay(arguments: &ReplayArguments, stop: &AtomicBool) -> anyhow::Result<ReplayReport> {
    for folder in &arguments.bundle {
        shared::open_bundle(folder)?;
    }
    let mut log = LogReader::open(&arguments.log)?;
    let engine = arguments.engine.filter(|kind| *kind != log.header().engine.kind);
    let engine = engine.map(EngineSettings::single_threaded);
    let mut replayer = Replayer::new(log.header(), &arguments.bundle, engine)?;
    let report = with_bar(stop, "replaying", |go_on| replayer.run(&mut log, go_on)).context("replaying")?;
    let BundleIdentity { preset, task, .. } = &report.log.bundle;
    let title =
        format!("{preset} bundle for {task}, engine {}: {} replayed ticks", report.engine.kind, report.ticks);
    if report.ticks_compared > 0 {
        write_latencies(&arguments.latency_files, replayer.telemetry(), &title, None)?;
    }
    Ok(report)
}

fn write(
    arguments: &ReplayArguments,
    folder: &std::path::Path,
    stop: &AtomicBool,
) -> anyhow::Result<WrittenEpisodes> {
    let mut log = LogReader::open(&arguments.log)?;
    with_bar(stop, "writing episodes", |go_on| write_episodes(&mut log, folder, go_on))
        .context("writing episodes")
}

/// Runs `work` with a bar over the log's bytes.
pub(super) fn with_bar<T>(
    stop: &AtomicBool,
    what: &'static str,
    work: impl FnOnce(&mut dyn FnMut((u64, u64)) -> bool) -> T,
) -> T {
    let bar = shared::progress_bar(0, what, "bytes");
    let mut entries: u64 = 0;
    let result = work(&mut |(read, bytes)| {
        entries += 1;
        // Drawing costs time that would disturb the next tick.
        if entries.is_multiple_of(64) {
            bar.set_length(bytes);
            bar.set_position(read);
        }
        !stop.load(Ordering::Relaxed)
    });
    bar.finish_and_clear();
    result
}

fn episode_lines(written: &WrittenEpisodes) -> String {
    let WrittenEpisodes { files, steps, left_out, left_out_because, present, .. } = written;
    let mut text = format!("episodes   {} written, {steps} steps", files.len());
    if *present > 0 {
        text += &format!("; {present} were there already");
    }
    if let Some(because) = left_out_because {
        text += &format!("; {left_out} left out, the first because of: {because}");
    }
    text.push('\n');
    for file in files.iter().take(5) {
        text += &format!("  {}\n", file.display());
    }
    if files.len() > 5 {
        text += &format!("  ... {} more\n", files.len() - 5);
    }
    text
}
