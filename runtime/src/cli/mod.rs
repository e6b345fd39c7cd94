//! The command line.
//!
//! | exit code | meaning |
//! | --- | --- |
//! | 0 | done; also when ended by Ctrl-C or SIGTERM, after the summary |
//! | 1 | an error: one line on stderr says which, and what to do; or a bundle that does not verify, a replay that differs |
//! | 2 | the command line was not understood |
//! | 3 | no observation came within --timeout |
//! | 130 | ended at once by a second Ctrl-C |

mod bench;
mod inspect;
mod observers;
mod replay;
mod run;
mod safety;
mod status;
mod swap;
mod telemetry;
mod verify;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::{Parser, Subcommand, ValueEnum};
use rcwm_models::bundle::Bundle;
use rcwm_models::errors::one_line;
use serde::Serialize;

use crate::controller::ControllerError;
use crate::engine::EngineKind;

/// How the program ends; the numbers are documented in `--help` and in `docs/controller.md`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum Exit {
    /// An error, or a bundle that did not verify. 2 is clap's, for usage.
    Error = 1,
    /// No observation came within --timeout.
    NoObservation = 3,
    /// The policy was unfit for --fallback-ticks-max ticks.
    Stopped = 4,
    /// The peer was silent for --silence-max.
    PeerLost = 5,
    /// A second Ctrl-C.
    AtOnce = 130,
}

impl From<&anyhow::Error> for Exit {
    fn from(error: &anyhow::Error) -> Self {
        match error.downcast_ref::<ControllerError>() {
            Some(ControllerError::NoObservation { .. }) => Self::NoObservation,
            Some(ControllerError::Stopped { .. }) => Self::Stopped,
            Some(ControllerError::PeerLost { .. }) => Self::PeerLost,
            Some(_) | None => Self::Error,
        }
    }
}

/// Deploys an exported RCWM bundle as a controller.
#[derive(Debug, Parser)]
#[command(name = "rcwm-runtime", version, about, after_help = EXAMPLES)]
struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

const EXAMPLES: &str = "\
Examples:
  rcwm-runtime inspect --bundle models/bundles/debug
  rcwm-runtime verify --bundle models/bundles/debug
  rcwm-runtime run --bundle models/bundles/debug --instance demo --record runs/demo --json runs/demo.json
  rcwm-runtime swap --instance demo --bundle models/bundles/debug --now
  rcwm-runtime bench --bundle models/bundles/debug --engine all --ticks 2000
  rcwm-runtime replay --log runs/demo.rcwmlog --bundle models/bundles/debug

Exit codes:
  0 done (also after Ctrl-C), 1 error or not verified, 2 usage, 3 no observation within --timeout, 4 stopped: the policy
  was unfit for --fallback-ticks-max ticks, 5 the peer was silent for --silence-max, 130 second Ctrl-C

Environment:
  ORT_DYLIB_PATH  ONNX Runtime's library, for --engine ort (PyPI onnxruntime: capi/libonnxruntime.so.1.31.1)
  RCWM_PREFIX     prefix in shared memory; peers meet only under the same one";

#[derive(Debug, Subcommand)]
enum Verb {
    /// Answers a simulator's (or a robot's) observations over shared memory
    Run(Box<run::RunArguments>),
    /// Has a run take over another bundle, without a missed tick
    Swap(swap::SwapArguments),
    /// Checks a bundle against its golden values: every part and the whole tick
    Verify(verify::VerifyArguments),
    /// Shows parts, shapes, sizes, operators, and what a tick costs
    Inspect(inspect::InspectArguments),
    /// Measures the tick's latency on this machine
    Bench(bench::BenchArguments),
    /// Makes a logged run's decisions again and compares them bit for bit; turns a log into episodes
    Replay(replay::ReplayArguments),
    /// Shows the latencies of a logged run, and writes and draws them
    Telemetry(telemetry::TelemetryArguments),
}

/// One engine or all that are there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum EngineChoice {
    /// tract, compiled in.
    Tract,
    /// ONNX Runtime.
    Ort,
    /// Both, where ONNX Runtime is present.
    All,
}

impl EngineChoice {
    /// The engines to use, and why one of them is left out. An engine that was asked for by name must be there.
    fn engines(self) -> anyhow::Result<(Vec<EngineKind>, Option<String>)> {
        match self {
            Self::Tract => Ok((vec![EngineKind::Tract], None)),
            Self::Ort => {
                crate::engine::available(EngineKind::Ort)?;
                Ok((vec![EngineKind::Ort], None))
            }
            Self::All => match crate::engine::available(EngineKind::Ort) {
                Ok(()) => Ok((vec![EngineKind::Tract, EngineKind::Ort], None)),
                Err(error) => Ok((vec![EngineKind::Tract], Some(error.to_string()))),
            },
        }
    }
}

/// Runs the program on the process's arguments.
#[must_use]
pub fn main() -> ExitCode {
    crate::realtime::keep_memory();
    let result = match Arguments::parse().verb {
        Verb::Run(arguments) => run::run(&arguments),
        Verb::Swap(arguments) => swap::run(&arguments),
        Verb::Verify(arguments) => verify::run(&arguments),
        Verb::Inspect(arguments) => inspect::run(&arguments),
        Verb::Bench(arguments) => bench::run(&arguments),
        Verb::Replay(arguments) => replay::run(&arguments),
        Verb::Telemetry(arguments) => telemetry::run(&arguments),
    };
    let code = result.map_or_else(
        |error| {
            eprintln!("error: {}", one_line(error.as_ref()));
            Exit::from(&error) as u8
        },
        |()| 0,
    );
    if crate::swap::desk_is_left() {
        // What this prints has gone out by lines; a pipe that is closed has nobody to be told.
        let _ = std::io::Write::flush(&mut std::io::stdout());
        // SAFETY: ends the process; nothing of it is used afterwards.
        unsafe { libc::_exit(i32::from(code)) }
    }
    ExitCode::from(code)
}

fn open_bundle(folder: &Path) -> anyhow::Result<Bundle> {
    if !folder.is_dir() {
        anyhow::bail!(
            "no bundle at {}: no such folder; `rcwm-trainer export --checkpoint DIR --out {}` makes one",
            folder.display(),
            folder.display()
        );
    }
    Bundle::open(folder).with_context(|| format!("{} is not a usable bundle", folder.display()))
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1e6).contains(&value) => Ok(value),
        _ => Err("expected seconds, 0 to 1000000".into()),
    }
}

fn write_json(path: Option<&PathBuf>, report: &impl Serialize) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    let mut json = serde_json::to_vec_pretty(report).context("writing JSON")?;
    json.push(b'\n');
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).with_context(|| format!("{}", folder.display()))?;
    }
    rcwm_models::files::write_atomic(path, &json)?;
    Ok(())
}

/// Signals this close together are one: supervisors and `timeout` signal a process, then its whole group.
const ONE_SIGNAL: Duration = Duration::from_millis(300);

/// A flag that Ctrl-C or SIGTERM sets; a second one, later, ends the process at once.
fn stop_flag() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let mut first: Option<Instant> = None;
    ctrlc::set_handler(move || {
        flag.store(true, Ordering::Relaxed);
        if first.get_or_insert_with(Instant::now).elapsed() > ONE_SIGNAL {
            std::process::exit(i32::from(Exit::AtOnce as u8));
        }
    })
    .context("listening for Ctrl-C")?;
    Ok(stop)
}

fn progress_bar(len: usize, what: &'static str) -> indicatif::ProgressBar {
    let style = indicatif::ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {elapsed}")
        .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar());
    indicatif::ProgressBar::new(len as u64).with_style(style).with_message(what)
}
