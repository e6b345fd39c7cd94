use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail};
use candle_core::Device;
use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::bundle::{Bundle, BundleKind};
use rcwm_models::interface::Interface;
use rcwm_models::tasks;
use rcwm_trainer::checkpoint::{Checkpoint, CheckpointError, SETTINGS_FILE};
use rcwm_trainer::export::{self, ExportError, Options, Progress};
use serde::Serialize;

use super::bars;

/// Export a checkpoint as a bundle that a runtime deploys
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer export --checkpoint runs/untrained --out bundles/untrained
  rcwm-trainer export --checkpoint runs/hammer --out bundles/hammer --task hammer --force
                      (a run's folder stands for its newest checkpoint)
  rcwm-trainer export --checkpoint runs/small/checkpoints/last --form checkpoint --half \\
      --out models/small")]
pub struct Export {
    /// Folder of the checkpoint, or of a run: its newest one
    #[arg(long, value_name = "DIR")]
    checkpoint: PathBuf,
    /// Folder of the bundle
    #[arg(long, value_name = "BUNDLE")]
    out: PathBuf,
    /// Task the policy was made for, one of Meta-World's or `own`
    #[arg(long, default_value = "own")]
    task: String,
    /// Which parts: all, or only those without which there is no policy
    #[arg(long, value_enum, default_value = "all")]
    parts: Parts,
    /// What to write: a bundle for the runtime, or a checkpoint without the optimisers' state to start from elsewhere
    #[arg(long, value_enum, default_value = "bundle")]
    form: Form,
    /// Round weights to what 16 bits hold: a checkpoint takes half the space, a bundle compresses to half
    #[arg(long)]
    half: bool,
    /// The robot that the policy is for, a file with [interface]; Meta-World's arm without one
    #[arg(long, value_name = "ROBOT.TOML")]
    interface: Option<PathBuf>,
    /// Decisions a second, where they are others than the interface's
    #[arg(long, value_name = "HZ")]
    rate_hz: Option<f64>,
    /// Make the golden values from the images of this episode (.npz) instead of synthetic ones
    #[arg(long, value_name = "FILE")]
    golden_episode: Option<PathBuf>,
    /// Ticks of golden values, at most
    #[arg(long, default_value_t = 32)]
    golden_ticks: usize,
    /// Seed of the golden noise
    #[arg(long, default_value_t = 0)]
    golden_seed: u64,
    /// Replace a bundle that is there
    #[arg(long)]
    force: bool,
    /// Write what was exported as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Parts {
    /// Every part, with reward, continue and decoder.
    All,
    /// Of rcwm encoder, robot, interaction, environment, actor; of vanilla encoder, dynamics, actor.
    Required,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Form {
    /// ONNX parts, manifest and golden values.
    Bundle,
    /// Weights and settings.
    Checkpoint,
}

#[derive(Serialize)]
struct Outcome<'a> {
    bundle: &'a PathBuf,
    bytes: u64,
    golden_bytes: u64,
    parts: Vec<PartSize<'a>>,
}

#[derive(Serialize)]
struct PartSize<'a> {
    name: &'a str,
    bytes: u64,
}

impl Export {
    fn interface(&self) -> Result<Interface> {
        let mut interface =
            self.interface.as_deref().map_or_else(|| Ok(Interface::metaworld()), Interface::read)?;
        interface.rate_hz = self.rate_hz.unwrap_or(interface.rate_hz);
        Ok(interface)
    }

    pub fn run(self) -> Result<ExitCode> {
        super::prepare_json(self.json.as_deref())?;
        if self.form == Form::Checkpoint {
            let of_bundles = [
                ("--golden-episode", self.golden_episode.is_some()),
                ("--json", self.json.is_some()),
                ("--parts", matches!(self.parts, Parts::Required)),
            ];
            if let Some((option, _)) = of_bundles.into_iter().find(|(_, given)| *given) {
                bail!("{option} is of a bundle; --form checkpoint writes weights and settings only");
            }
        }
        if self.task != tasks::task_name(tasks::OWN_TASK) {
            tasks::task_id(&self.task).with_context(|| "--task")?;
        }
        let mut checkpoint = Checkpoint::read(&self.checkpoint, &Device::Cpu)?;
        if self.half {
            checkpoint = checkpoint.rounded()?;
        }
        // What is shipped says which episodes it learnt from, not where they lie on this machine.
        if let Some(folder) = Path::new(&checkpoint.settings.data).file_name() {
            checkpoint.settings.data = folder.to_string_lossy().into_owned();
        }
        if self.form == Form::Checkpoint {
            return self.checkpoint(&checkpoint);
        }
        let kind = BundleKind::of(checkpoint.settings.model.kind);
        let options = Options {
            task: self.task.clone(),
            interface: self.interface()?,
            parts: match self.parts {
                Parts::All => kind.all_parts().collect(),
                Parts::Required => kind.parts().to_vec(),
            },
            golden_episode: self.golden_episode.clone(),
            golden_ticks: self.golden_ticks,
            golden_seed: self.golden_seed,
            source_revision: env!("RCWM_SOURCE_REVISION").to_owned(),
            replace: self.force,
        };
        let bar = Bar::new()?;
        let bundle = export::write(&checkpoint, &self.out, &options, &bar);
        bar.bar.finish_and_clear();
        self.summarise(&bundle?)?;
        Ok(ExitCode::SUCCESS)
    }

    fn checkpoint(&self, checkpoint: &Checkpoint) -> Result<ExitCode> {
        if !self.force && self.out.join(SETTINGS_FILE).exists() {
            return Err(CheckpointError::Exists { path: self.out.clone() }.into());
        }
        checkpoint.write(&self.out)?;
        rcwm_models::outln!(
            "checkpoint of {} updates in {}",
            checkpoint.settings.updates,
            self.out.display()
        );
        Ok(ExitCode::SUCCESS)
    }

    fn summarise(&self, bundle: &Bundle) -> Result<()> {
        let manifest = &bundle.manifest;
        let parts =
            manifest.parts.iter().map(|part| PartSize { name: part.name.as_str(), bytes: part.bytes });
        let outcome = Outcome {
            bundle: &self.out,
            bytes: manifest.parts.iter().map(|part| part.bytes).sum(),
            golden_bytes: manifest.golden.bytes,
            parts: parts.collect(),
        };
        if let Some(path) = &self.json {
            super::write_json(path, &outcome)?;
        }
        for part in &outcome.parts {
            rcwm_models::outln!("{:<12} {:>8.2} MB", part.name, part.bytes as f64 / 1e6);
        }
        rcwm_models::outln!(
            "{:<12} {:>8.2} MB, {}",
            "golden",
            outcome.golden_bytes as f64 / 1e6,
            manifest.provenance.data
        );
        rcwm_models::outln!("bundle in {}", self.out.display());
        Ok(())
    }
}

/// A progress bar that Ctrl-C stops.
struct Bar {
    bar: bars::Bar,
    interrupted: Arc<AtomicBool>,
}

impl Bar {
    fn new() -> Result<Self> {
        let bar = bars::Bar::new(ProgressBar::new(0), "exporting", "steps");
        bar.set_style(ProgressStyle::with_template("{msg:<32} {bar:30} {pos}/{len}")?);
        let interrupted = Arc::new(AtomicBool::new(false));
        let flag = interrupted.clone();
        ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).context("listening for Ctrl-C")?;
        Ok(Self { bar, interrupted })
    }
}

impl Progress for Bar {
    fn step(&self, what: &str, done: usize, total: usize) -> Result<(), ExportError> {
        if self.interrupted.load(Ordering::Relaxed) {
            return Err(ExportError::Interrupted);
        }
        self.bar.set_length(total as u64);
        self.bar.set_position(done as u64);
        self.bar.set_message(what);
        Ok(())
    }
}
