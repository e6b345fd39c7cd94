//! `rcwm-lab export-mcap`.

use std::path::PathBuf;

use clap::Args;
use rcwm_runtime::cli::shared;
use rcwm_runtime::log::LogReader;

use super::replay::with_bar;
use crate::mcap::{Compression, Exported, WallClock, export};

/// Arguments of `export-mcap`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-runtime run --bundle models/bundles/hammer --instance demo --log runs/demo.rcwmlog\n  \
    rcwm-lab export-mcap --log runs/demo.rcwmlog --out runs/demo.mcap\n  \
    rcwm-lab export-mcap --log runs/demo.rcwmlog --out runs/first.mcap --episodes 1 --json export.json\n\n\
    Pictures, states, actions sent and executed, reward, surprise, latencies and modes as ROS 2's messages (profile ros2, CDR), with\n\
    their definitions: Foxglove, rerun and `ros2 bag` open the same file. docs/mcap.md names the topics. A log that was cut is\n\
    exported up to the cut, and so is one that Ctrl-C stops.")]
pub(super) struct ExportMcapArguments {
    /// The log
    #[arg(long, value_name = "FILE")]
    log: PathBuf,
    /// The MCAP file; one that is there is not written over
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Exports at most this many episodes; all unless given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: Option<u64>,
    /// How the file is packed
    #[arg(long, value_enum, default_value_t = Compression::Lz4)]
    compression: Compression,
    /// Writes what was exported to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn run(arguments: &ExportMcapArguments) -> anyhow::Result<()> {
    let ExportMcapArguments { log, out, episodes, compression, json } = arguments;
    anyhow::ensure!(json.as_ref() != Some(out), "--out and --json name one file, {}", out.display());
    shared::prepare_json(json.as_deref())?;
    let stop = shared::stop_flag()?;
    let mut log = LogReader::open(log)?;
    let exported =
        with_bar(&stop, "exporting", |go_on| export(&mut log, out, *compression, *episodes, go_on))?;
    shared::write_json(json.as_deref(), &exported)?;
    rcwm_models::out!("{}", lines(&exported));
    match exported.log_damage {
        Some(damage) => anyhow::bail!("{damage}; all before it was exported"),
        None => Ok(()),
    }
}

/// What was exported, for people.
fn lines(exported: &Exported) -> String {
    let Exported { file, ticks, episodes, messages, pictures, bytes, topics, .. } = exported;
    let mib = *bytes as f64 / f64::from(1 << 20);
    let mut text = format!(
        "exported   {}: {ticks} ticks of {episodes} episodes, {messages} messages on {} topics, {mib:.1} MiB\n",
        file.display(),
        topics.len()
    );
    if *ticks == 0 {
        text += "           the log holds no tick\n";
    } else if *pictures == 0 {
        text += "           the log holds no pictures: all else was exported\n";
    }
    if exported.wall_clock == WallClock::Estimated {
        text += "           the log is of an older program and does not say what its clock read: dates and times of day are too early by \
                 the time that the run waited for its robot\n";
    }
    if exported.stopped {
        text += "           stopped before the end of the log\n";
    }
    text
}
