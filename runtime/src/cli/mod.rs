//! The command line.
//!
//! | exit code | meaning |
//! | --- | --- |
//! | 0 | done; also when ended by Ctrl-C or SIGTERM, after the summary |
//! | 1 | an error: one line on stderr says which, and what to do; or a bundle that does not verify, a replay that differs |
//! | 2 | the command line was not understood |
//! | 3 | no observation came within --timeout |
//! | 4 | stopped: the policy gave nothing valid for --fallback-ticks-max ticks |
//! | 5 | the peer was silent for --silence-max |
//! | 130 | ended at once by a second Ctrl-C |

mod bench;
mod inspect;
mod observers;
mod remarks;
mod replay;
mod run;
mod safety;
mod status;
mod swap;
mod telemetry;
mod verify;

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::{Parser, Subcommand, ValueEnum};
use rcwm_models::bundle::Bundle;
use rcwm_models::errors::one_line;
use rcwm_models::files::{Output, prepare_output, write_output};
use rcwm_models::progress::Bar;
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
    /// The policy gave nothing valid for --fallback-ticks-max ticks.
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
  rcwm-runtime inspect --bundle models/bundles/hammer
  rcwm-runtime verify --bundle models/bundles/hammer
  rcwm-runtime run --bundle models/bundles/hammer --instance demo --record runs/demo
  rcwm-runtime swap --instance demo --bundle models/bundles/hammer --now
  rcwm-runtime bench --bundle models/bundles/hammer --engine all --ticks 2000
  rcwm-runtime replay --log runs/demo.rcwmlog --bundle models/bundles/hammer

Exit codes:
  0 done (also after Ctrl-C), 1 error or not verified, 2 usage, 3 no observation within --timeout, 4 stopped: the policy
  gave nothing valid for --fallback-ticks-max ticks, 5 the peer was silent for --silence-max, 130 second Ctrl-C

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
    // What standard output has lost is an error, too, but not the first to be told.
    let told = || rcwm_models::terminal::finish().context("standard output");
    let code = match result.and_then(|()| told()) {
        Ok(()) => 0,
        Err(error) => {
            rcwm_models::errln!("error: {}", one_line(error.as_ref()));
            Exit::from(&error) as u8
        }
    };
    if crate::swap::server_is_left() {
        // SAFETY: ends the process; nothing of it is used afterwards.
        unsafe { libc::_exit(i32::from(code)) }
    }
    ExitCode::from(code)
}

fn open_bundle(folder: &Path) -> anyhow::Result<Bundle> {
    if folder.is_file() {
        anyhow::bail!("{} is a file; expected the folder of a bundle, with manifest.toml", folder.display());
    }
    let checkpoint = ["", "checkpoints/last"].map(|place| folder.join(place).join("checkpoint.toml"));
    if !folder.join("manifest.toml").exists() && checkpoint.iter().any(|file| file.is_file()) {
        anyhow::bail!(
            "{} is a checkpoint of the trainer, no bundle; `rcwm-trainer export --checkpoint {0} --out BUNDLE` makes one",
            folder.display()
        );
    }
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

/// Makes sure before the work that its result can be written.
fn prepare_json(path: Option<&Path>) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    prepare_output(path, Output::Json).context("--json")
}

fn write_json(path: Option<&Path>, report: &impl Serialize) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    let mut json = serde_json::to_vec_pretty(report).context("writing JSON")?;
    json.push(b'\n');
    write_output(path, &json).context("--json")
}

/// Signals this close together are one: supervisors and `timeout` signal a process, then its whole group.
const ONE_SIGNAL: Duration = Duration::from_millis(300);
/// Time for what is done before the process ends at once.
const LAST_DEED: Duration = Duration::from_secs(1);

/// A flag that Ctrl-C or SIGTERM sets; a second one, later, ends the process at once.
fn stop_flag() -> anyhow::Result<Arc<AtomicBool>> {
    stop_flag_after(|| ())
}

/// The same; before a second signal ends the process, `last` is done, for which there is a second.
fn stop_flag_after(last: impl Fn() + Clone + Send + 'static) -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let mut first: Option<Instant> = None;
    ctrlc::set_handler(move || {
        flag.store(true, Ordering::Relaxed);
        if first.get_or_insert_with(Instant::now).elapsed() > ONE_SIGNAL {
            let (done, is_done) = std::sync::mpsc::channel();
            let last = last.clone();
            let work = move || {
                last();
                done.send(())
            };
            // What takes longer, panics or finds no thread is not waited for.
            if std::thread::Builder::new().spawn(work).is_ok() {
                let _ = is_done.recv_timeout(LAST_DEED);
            }
            std::process::exit(i32::from(Exit::AtOnce as u8));
        }
    })
    .context("listening for Ctrl-C")?;
    Ok(stop)
}

fn progress_bar(len: usize, what: &'static str, unit: &'static str) -> Bar {
    let style = indicatif::ProgressStyle::with_template("{prefix} {wide_bar} {pos}/{len} {elapsed}")
        .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar());
    Bar::new(indicatif::ProgressBar::new(len as u64).with_style(style).with_prefix(what), what, unit)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn every_example_is_understood_and_names_files_that_are_shipped() {
        let command = Arguments::command();
        let all = std::iter::once(command.clone()).chain(command.get_subcommands().cloned());
        let texts: Vec<_> = all.map(|mut verb| verb.render_long_help().ansi().to_string()).collect();
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let parse = |example: &[String]| {
            Arguments::try_parse_from(example).map(drop).map_err(|error| error.to_string())
        };
        let count = rcwm_models::help::check_examples(&texts, "rcwm-runtime", &root, parse).unwrap();
        assert!(count > 10, "only {count} examples");
    }

    #[test]
    fn options_that_would_be_ignored_are_refused() {
        for refused in [
            "run --bundle b --instance a --seed 3",
            "run --bundle b --instance a --record-episodes 2",
            "run --bundle b --instance a --telemetry-every 2s",
            "run --bundle b --instance a --realtime-priority 20",
            "bench --bundle b --ablation --engine ort",
            "replay --log l --episodes e --engine tract",
        ] {
            let words = std::iter::once("program").chain(refused.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_err(), "{refused}");
        }
        for taken in [
            "run --bundle b --instance a --sample --seed 3",
            "run --bundle b --instance a --record r --record-episodes 2",
            "bench --bundle b --ablation",
            "replay --log l --bundle b --engine tract",
        ] {
            let words = std::iter::once("program").chain(taken.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_ok(), "{taken}");
        }
    }
}
