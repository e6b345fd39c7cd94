use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use candle_core::Device;
use rcwm_trainer::checkpoint::{self, Checkpoint, CheckpointError, CheckpointSettings};
use rcwm_trainer::model::agent;

/// Make an untrained checkpoint
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer init --preset debug --seed 1 --out runs/untrained
  rcwm-trainer init --preset paper --model vanilla --out runs/baseline")]
pub struct Init {
    #[command(flatten)]
    model: super::ModelArguments,
    /// Seed of the weights
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder of the checkpoint
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Replace a checkpoint that is there
    #[arg(long)]
    force: bool,
}

impl Init {
    pub fn run(self) -> Result<ExitCode> {
        if !self.force && self.out.join(checkpoint::SETTINGS_FILE).exists() {
            return Err(CheckpointError::Exists { path: self.out }.into());
        }
        let model = self.model.settings()?;
        let parameters = agent::initialise(&model, self.seed, &Device::Cpu)?;
        let settings = CheckpointSettings {
            format: checkpoint::FORMAT,
            preset: self.model.name(),
            seed: self.seed,
            updates: 0,
            data: "none: untrained".into(),
            cpu_seconds: 0.0,
            weights_sha256: String::new(),
            model,
        };
        Checkpoint { settings, parameters }.write(&self.out)?;
        rcwm_models::outln!("untrained checkpoint in {}", self.out.display());
        Ok(ExitCode::SUCCESS)
    }
}
