//! The command line. Exit codes are those of rcwm-runtime: 0 done, 1 an error, or a replay that differs, 2 usage, 130 second Ctrl-C.

mod bench;
mod bundle;
mod export_mcap;
mod film;
mod inspect;
mod plot;
mod replay;
mod telemetry;
mod watch;

use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use rcwm_models::errors::one_line;

/// Looks at what rcwm-runtime deploys and has logged: replays, films, plots, measurements.
#[derive(Debug, Parser)]
#[command(name = "rcwm-lab", version, about, after_help = EXAMPLES)]
struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

const EXAMPLES: &str = "\
Examples:
  rcwm-lab inspect --bundle models/bundles/hammer
  rcwm-lab bundle --onnx policy.onnx --interface models/src/interface/arm.toml --out bundles/policy
  rcwm-lab bench --bundle models/bundles/hammer --engine all --ticks 2000
  rcwm-lab replay --log runs/demo.rcwmlog --bundle models/bundles/hammer
  rcwm-lab film --log runs/demo.rcwmlog --bundle models/bundles/hammer --out runs/demo
  rcwm-lab export-mcap --log runs/demo.rcwmlog --out runs/demo.mcap
  rcwm-lab watch --instance demo

Exit codes:
  0 done (also after Ctrl-C), 1 error or a replay that differs, 2 usage, 130 second Ctrl-C

Environment:
  ORT_DYLIB_PATH  ONNX Runtime's library, for --engine ort (PyPI onnxruntime: capi/libonnxruntime.so.1.31.1)";

#[derive(Debug, Subcommand)]
enum Verb {
    /// Shows parts, shapes, sizes, operators, and what a tick costs
    Inspect(inspect::InspectArguments),
    /// Makes a bundle of an ONNX policy of any library, for a robot
    Bundle(bundle::BundleArguments),
    /// Measures the tick's latency on this machine
    Bench(bench::BenchArguments),
    /// Makes a logged run's decisions again and compares them bit for bit; turns a log into episodes
    Replay(replay::ReplayArguments),
    /// Draws films, strips and episodes of a logged run
    Film(film::FilmArguments),
    /// Writes a logged run as MCAP, which Foxglove, rerun and ROS 2 open
    ExportMcap(export_mcap::ExportMcapArguments),
    /// Shows the latencies of a logged run, and writes and draws them
    Telemetry(telemetry::TelemetryArguments),
    /// Shows a robot and its controller while they run, in a terminal
    Watch(watch::WatchArguments),
    /// Draws latency files (--hgrm) as a picture
    Plot(plot::PlotArguments),
}

/// Runs the program on the process's arguments.
#[must_use]
pub fn main() -> ExitCode {
    rcwm_runtime::realtime::keep_memory();
    let result = match Arguments::parse().verb {
        Verb::Inspect(arguments) => inspect::run(&arguments),
        Verb::Bundle(arguments) => bundle::run(&arguments),
        Verb::Bench(arguments) => bench::run(&arguments),
        Verb::Replay(arguments) => replay::run(&arguments),
        Verb::Film(arguments) => film::run(&arguments),
        Verb::ExportMcap(arguments) => export_mcap::run(&arguments),
        Verb::Telemetry(arguments) => telemetry::run(&arguments),
        Verb::Watch(arguments) => watch::run(&arguments),
        Verb::Plot(arguments) => plot::run(&arguments),
    };
    // What standard output has lost is an error, too, but not the first to be told.
    let told = || rcwm_models::terminal::finish().context("standard output");
    match result.and_then(|()| told()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            rcwm_models::errln!("error: {}", one_line(error.as_ref()));
            ExitCode::FAILURE
        }
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
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let parse = |example: &[String]| {
            Arguments::try_parse_from(example).map(drop).map_err(|error| error.to_string())
        };
        let count = rcwm_models::help::check_examples(&texts, "rcwm-lab", &root, parse).unwrap();
        assert!(count > 8, "only {count} examples");
    }

    #[test]
    fn options_that_would_be_ignored_are_refused() {
        for refused in
            ["bench --bundle b --ablation --engine ort", "replay --log l --episodes e --engine tract"]
        {
            let words = std::iter::once("program").chain(refused.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_err(), "{refused}");
        }
        for taken in ["bench --bundle b --ablation", "replay --log l --bundle b --engine tract"] {
            let words = std::iter::once("program").chain(taken.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_ok(), "{taken}");
        }
    }
}
