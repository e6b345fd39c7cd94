//! The command line, one file per verb.

mod bars;
mod card;
mod collect;
mod evaluate;
mod export;
mod fewshot;
mod finetune;
mod import;
mod init;
mod online;
mod parameters;
mod parity;
mod pretrain;
mod report;
mod train;

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};
use candle_core::Device;
use clap::{Parser, Subcommand, ValueEnum};
use rcwm_gpu::{Machine, Precision};
use rcwm_models::files::Output;
use rcwm_models::settings::{self, ModelKind, ModelSettings, Preset};
use rcwm_trainer::gpu::Share;
use rcwm_trainer::training::Compute;

/// Learns the Robo-Centric World Model and exports it.
#[derive(Debug, Parser)]
#[command(name = "rcwm-trainer", version, about, max_term_width = 110)]
pub struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Collect(collect::Collect),
    Parameters(parameters::Parameters),
    Parity(parity::Parity),
    Import(import::Import),
    Init(init::Init),
    Export(export::Export),
    Evaluate(Box<evaluate::Evaluate>),
    Card(card::Card),
    Pretrain(pretrain::Pretrain),
    Fewshot(fewshot::Fewshot),
    Finetune(finetune::Finetune),
    Train(train::Train),
}

impl Arguments {
    /// Runs the verb.
    pub fn run(self) -> Result<ExitCode> {
        match self.verb {
            Verb::Collect(verb) => verb.run(),
            Verb::Parameters(verb) => verb.run(),
            Verb::Parity(verb) => verb.run(),
            Verb::Import(verb) => verb.run(),
            Verb::Init(verb) => verb.run(),
            Verb::Export(verb) => verb.run(),
            Verb::Evaluate(verb) => verb.run(),
            Verb::Card(verb) => verb.run(),
            Verb::Pretrain(verb) => verb.run(),
            Verb::Fewshot(verb) => verb.run(),
            Verb::Finetune(verb) => verb.run(),
            Verb::Train(verb) => verb.run(),
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum PresetName {
    /// Runs every code path in milliseconds.
    Debug,
    /// Trains on two CPU cores.
    Small,
    /// The paper's.
    Paper,
}

impl PresetName {
    fn preset(self) -> Preset {
        match self {
            Self::Debug => Preset::Debug,
            Self::Small => Preset::Small,
            Self::Paper => Preset::Paper,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ModelName {
    /// Robot and environment branch with interaction.
    Rcwm,
    /// One branch: the DreamerV3 baseline.
    Vanilla,
}

impl ModelName {
    fn kind(self) -> ModelKind {
        match self {
            Self::Rcwm => ModelKind::Rcwm,
            Self::Vanilla => ModelKind::Vanilla,
        }
    }
}

/// Which model, of which sizes.
#[derive(Debug, clap::Args)]
struct ModelArguments {
    /// Sizes to start from
    #[arg(long, value_enum, default_value = "small")]
    preset: PresetName,
    /// Which world model
    #[arg(long, value_enum, default_value = "rcwm")]
    model: ModelName,
    /// Change one setting, for example --set cnn_depth=16 (repeatable)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl ModelArguments {
    /// The resolved sizes. They may be named as in the settings of a run, too: `model.cnn_depth`.
    fn settings(&self) -> Result<ModelSettings> {
        let own = |text: &String| text.strip_prefix("model.").unwrap_or(text).to_owned();
        let overrides: Vec<String> = self.overrides.iter().map(own).collect();
        let preset = ModelSettings::preset(self.preset.preset(), self.model.kind());
        let resolved = settings::with_overrides(&preset, &overrides)?;
        resolved.validate()?;
        Ok(resolved)
    }

    /// The preset's name, or `custom` where it was changed.
    fn name(&self) -> String {
        if !self.overrides.is_empty() {
            return "custom".to_owned();
        }
        self.preset.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }
}

/// `cpu`, or `cuda` or `cuda:N` in a build with the feature `cuda`.
fn parse_device(text: &str) -> Result<Device> {
    match text.split_once(':').unwrap_or((text, "0")) {
        ("cpu", _) => Ok(Device::Cpu),
        ("cuda", index) => {
            let index = index.parse().with_context(|| format!("--device {text}: expected cuda:N"))?;
            Device::new_cuda(index).with_context(|| {
                format!("--device {text}: needs a CUDA device and a build with --features cuda")
            })
        }
        _ => anyhow::bail!("--device {text}: expected cpu, cuda or cuda:N"),
    }
}

/// Where the updates of a run are computed.
#[derive(Debug, clap::Args)]
struct ComputeArguments {
    /// Where updates are computed: cpu, cuda or cuda:N (an NVIDIA GPU; driver and CUDA 13 are looked
    /// for when it is asked for)
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Precision of matrix products on a GPU: tf32 rounds the factors to 10 bits, sums stay f32
    #[arg(long, value_enum, default_value = "f32")]
    precision: PrecisionName,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum PrecisionName {
    F32,
    Tf32,
}

impl ComputeArguments {
    /// Where so many runs are computed that learn at once: on a GPU they share programs and images.
    fn computes(&self, runs: usize) -> Result<Vec<Compute>> {
        Ok(match self.machine()? {
            None => (0..runs).map(|_| Compute::Tensors(Device::Cpu)).collect(),
            Some(machine) => Compute::programs(machine.for_runs(runs)),
        })
    }

    /// Where one run is computed.
    fn compute(&self) -> Result<Compute> {
        Ok(match self.machine()? {
            None => Compute::Tensors(Device::Cpu),
            Some(machine) => Compute::Programs(Share::alone(machine)),
        })
    }

    /// The GPU that is asked for; none: the CPU.
    fn machine(&self) -> Result<Option<Machine>> {
        let text = &self.device;
        let precision = match self.precision {
            PrecisionName::F32 => Precision::F32,
            PrecisionName::Tf32 => Precision::Tf32,
        };
        match text.split_once(':').unwrap_or((text, "0")) {
            ("cpu", _) if self.precision != PrecisionName::F32 => {
                anyhow::bail!(
                    "--precision is of updates on a GPU: name one with --device cuda, or leave it out"
                )
            }
            ("cpu", _) => Ok(None),
            ("cuda", index) => {
                let index = index.parse().with_context(|| format!("--device {text}: expected cuda:N"))?;
                let machine = Machine::nvidia(index, precision);
                Ok(Some(machine.with_context(|| format!("--device {text}"))?))
            }
            _ => anyhow::bail!("--device {text}: expected cpu, cuda or cuda:N"),
        }
    }
}

/// Set by the first Ctrl-C; the second one ends the program at once.
fn stop_on_ctrl_c() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let heard = Arc::clone(&stop);
    ctrlc::set_handler(move || {
        // The second one no longer waits for the checkpoint.
        if heard.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })
    .context("Ctrl-C could not be caught")?;
    Ok(stop)
}

/// Makes sure before the work that what it measures can be written.
fn prepare_json(path: Option<&Path>) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    rcwm_models::files::prepare_output(path, Output::Json).context("--json")
}

/// Writes what a verb measured as JSON.
fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    rcwm_models::files::write_output(path, &text).context("--json")
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
        let count = rcwm_models::help::check_examples(&texts, "rcwm-trainer", &root, parse).unwrap();
        assert!(count > 25, "only {count} examples");
    }

    #[test]
    fn options_that_would_be_ignored_are_refused() {
        for refused in [
            "fewshot --resume --out o --from c",
            "fewshot --resume --out o --task reach",
            "finetune --resume --out o --from c",
            "train --resume --out o --seed 3",
            "collect --join a --out o --disturb noise",
            "collect --join a --out o --steps-max 9",
            "collect --join a --out o --simulators 2",
            "evaluate --checkpoint c --data d --episodes 4",
            "evaluate --checkpoint c --data d --disturb noise",
            "evaluate --checkpoint c --task reach --trajectories 4",
            "evaluate --checkpoint c --task reach --device cpu",
            "parameters --checkpoint c --preset small",
        ] {
            let words = std::iter::once("program").chain(refused.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_err(), "{refused}");
        }
        for taken in [
            "fewshot --resume --out o --data d",
            "evaluate --checkpoint c --data d --trajectories 4",
            "evaluate --checkpoint c --task reach --episodes 4",
            "evaluate --report r --checkpoint c --data d --bundles b --episodes 4 --trajectories 4",
        ] {
            let words = std::iter::once("program").chain(taken.split_whitespace());
            assert!(Arguments::try_parse_from(words).is_ok(), "{taken}");
        }
    }
}
