//! `rcwm-lab watch`.

use std::fs::OpenOptions;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;
use rcwm_runtime::cli::shared;

use crate::watch::{Colours, Snapshot, terminal, watch_in_lines, watch_on_screen};

/// Arguments of `watch`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-lab watch --instance arm\n  \
    rcwm-lab watch --instance arm --colours 256 --seconds 60\n  \
    rcwm-lab watch --instance arm --json -\n\n\
    Rate, deadlines missed, latency from observation to action, the controller's mode, a camera's picture, actions between their\n\
    limits and states. It listens in on the link: nobody waits for it, and robot and controller may come and go. Where there is no\n\
    terminal it prints a line every second. Keys: q quits, p pauses, c shows the next camera.")]
pub(super) struct WatchArguments {
    /// Name of the link: the robot's --instance
    #[arg(long, value_name = "NAME")]
    instance: String,
    /// Colours of pictures; what the terminal says it has unless given
    #[arg(long, value_enum, conflicts_with = "json")]
    colours: Option<Colours>,
    /// Ends after so long
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    seconds: Option<Duration>,
    /// Appends a JSON line to this file every second, and draws nothing; - is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

fn seconds(text: &str) -> Result<Duration, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e9 => Ok(Duration::from_secs_f64(value)),
        _ => Err("expected seconds above 0".into()),
    }
}

pub(super) fn run(arguments: &WatchArguments) -> anyhow::Result<()> {
    let WatchArguments { instance, colours, seconds, json } = arguments;
    shared::prepare_json(json.as_deref())?;
    let stop = shared::stop_flag_after(terminal::restore)?;
    // What it watches goes first. Where that is not allowed it watches all the same.
    let _ = rustix::process::nice(10);
    let start = Instant::now();
    let is_over = || seconds.is_some_and(|seconds| start.elapsed() >= seconds);
    let go_on = || !stop.load(Ordering::Relaxed) && !is_over();
    match json {
        Some(path) => watch_in_lines(instance, &mut open(path)?, json_line, go_on),
        None if terminal::is_there() => {
            watch_on_screen(instance, colours.unwrap_or_else(Colours::of_terminal), go_on)
        }
        None => watch_in_lines(instance, &mut io::stdout(), Snapshot::line, go_on),
    }
}

fn open(path: &Path) -> anyhow::Result<Box<dyn Write>> {
    if path == Path::new("-") {
        return Ok(Box::new(io::stdout()));
    }
    let file = OpenOptions::new().append(true).create(true).open(path);
    Ok(Box::new(file.with_context(|| format!("--json {}", path.display()))?))
}

fn json_line(snapshot: &Snapshot) -> String {
    // Numbers and names: nothing in it can fail to be JSON.
    serde_json::to_string(snapshot).unwrap_or_default() + "\n"
}
