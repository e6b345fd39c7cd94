//! The command line.
//!
//! | exit code | meaning |
//! | --- | --- |
//! | 0 | done; also when ended by Ctrl-C or SIGTERM, after the summary |
//! | 1 | an error: one line on stderr says which, and what to do; or a bundle that does not verify |
//! | 2 | the command line was not understood |
//! | 3 | no observation came within --timeout |
//! | 4 | stopped: the policy gave nothing valid for --fallback-ticks-max ticks |
//! | 5 | the peer was silent for --silence-max |
//! | 130 | ended at once by a second Ctrl-C |

mod check;
mod lab;
mod observers;
mod remarks;
mod run;
mod safety;
pub mod shared;
mod status;
mod swap;
mod verify;

use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use rcwm_models::errors::one_line;

use crate::controller::ControllerError;

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

/// Deploys a bundle (RCWM, DreamerV3 or any ONNX policy) as a controller.
#[derive(Debug, Parser)]
#[command(name = "rcwm-runtime", version, about, after_help = EXAMPLES)]
struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

const EXAMPLES: &str = "\
Examples:
  rcwm-runtime check models/src/interface/metaworld.toml --bundle models/bundles/hammer
  rcwm-runtime verify --bundle models/bundles/hammer
  rcwm-runtime run --bundle models/bundles/hammer --instance demo --record runs/demo
  rcwm-runtime swap --instance demo --bundle models/bundles/hammer --now

What is looked at afterwards is rcwm-lab's: inspect, bundle, bench, replay, telemetry, film, plot. Named here they are passed on.

Exit codes:
  0 done (also after Ctrl-C), 1 error or not verified, 2 usage, 3 no observation within --timeout, 4 stopped: the policy
  gave nothing valid for --fallback-ticks-max ticks, 5 the peer was silent for --silence-max, 130 second Ctrl-C

Environment:
  ORT_DYLIB_PATH  ONNX Runtime's library, for --engine ort (PyPI onnxruntime: capi/libonnxruntime.so.1.31.1)
  RCWM_LAB        rcwm-lab's path, where it is neither beside this program nor on the PATH
  RCWM_PREFIX     prefix in shared memory; peers meet only under the same one";

#[derive(Debug, Subcommand)]
enum Verb {
    /// Answers a simulator's (or a robot's) observations over shared memory
    Run(Box<run::RunArguments>),
    /// Has a run take over another bundle, without a missed tick
    Swap(swap::SwapArguments),
    /// Says what a robot offers, and whether a bundle fits it; nothing is started
    Check(check::CheckArguments),
    /// Checks a bundle against its golden values: every part and the whole tick
    Verify(verify::VerifyArguments),
}

/// Runs the program on the process's arguments.
#[must_use]
pub fn main() -> ExitCode {
    if let Some(code) = lab::pass_on() {
        return code;
    }
    crate::realtime::keep_memory();
    let result = match Arguments::parse().verb {
        Verb::Check(arguments) => check::run(&arguments),
        Verb::Run(arguments) => run::run(&arguments),
        Verb::Swap(arguments) => swap::run(&arguments),
        Verb::Verify(arguments) => verify::run(&arguments),
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

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1e6).contains(&value) => Ok(value),
        _ => Err("expected seconds, 0 to 1000000".into()),
    }
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
        assert!(count > 6, "only {count} examples");
    }

    #[test]
    fn options_that_would_be_ignored_are_refused() {
        for refused in [
            "run --bundle b --instance a --seed 3",
            "run --bundle b --instance a --record-episodes 2",
            "run --bundle b --instance a --telemetry-every 2s",
            "run --bundle b --instance a --realtime-priority 20",
        ] {
            let words = std::iter::once("program").chain(refused.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_err(), "{refused}");
        }
        for taken in [
            "run --bundle b --instance a --sample --seed 3",
            "run --bundle b --instance a --record r --record-episodes 2",
        ] {
            let words = std::iter::once("program").chain(taken.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_ok(), "{taken}");
        }
    }
}
