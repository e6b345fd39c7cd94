use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use rcwm_trainer::checkpoint::{self, Checkpoint, CheckpointError, CheckpointSettings};
use rcwm_trainer::import::{Format, Imported, import};

/// Make a checkpoint from one of another implementation (PyTorch's latest.pt; nothing in it is executed)
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer import --from tests/data/import/rcwm-authors.pt --format rcwm-authors \\
      --out runs/authors
  rcwm-trainer import --from tests/data/import/dreamerv3-torch.pt --format dreamerv3-torch \\
      --classes 8 --out runs/dreamer

The sizes are read off the tensors' shapes. Every tensor of floating-point numbers is accounted for:
it becomes a parameter, is a copy of one, or is no part of the model; anything else is refused.")]
pub struct Import {
    /// The file
    #[arg(long, value_name = "FILE")]
    from: PathBuf,
    /// Whose it is
    #[arg(long, value_enum)]
    format: Format,
    /// Classes of a categorical, which dreamerv3-torch's shapes do not tell: its dyn_discrete, 32 unless it was changed
    #[arg(long, value_name = "M", required_if_eq("format", "dreamerv3-torch"))]
    classes: Option<usize>,
    /// Folder of the checkpoint
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Replace a checkpoint that is there
    #[arg(long)]
    force: bool,
}

impl Import {
    pub fn run(self) -> Result<ExitCode> {
        if !self.force && self.out.join(checkpoint::SETTINGS_FILE).exists() {
            return Err(CheckpointError::Exists { path: self.out }.into());
        }
        anyhow::ensure!(
            self.format != Format::RcwmAuthors || self.classes.is_none(),
            "--classes: the authors' shapes tell them; leave it out"
        );
        let Imported { parameters, settings: model, taken, copies, left } =
            import(&self.from, self.format, self.classes.unwrap_or_default())?;
        let name = self.from.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let settings = CheckpointSettings {
            format: checkpoint::FORMAT,
            preset: "custom".into(),
            seed: 0,
            updates: 0,
            data: format!("imported from {}: {name}", self.format.name()),
            cpu_seconds: 0.0,
            weights_sha256: String::new(),
            model,
        };
        let (n, m, depth) = (settings.model.categoricals, settings.model.classes, settings.model.cnn_depth);
        let deter = settings.model.deter;
        Checkpoint { settings, parameters }.write(&self.out)?;
        rcwm_models::outln!("depth {depth}, {n} x {m} latents, width {deter}");
        rcwm_models::outln!(
            "{taken} tensors taken, {copies} copies of them, {} not of the model{}",
            left.len(),
            left.first().map_or_else(String::new, |first| format!(" ({first}, ...)"))
        );
        rcwm_models::outln!("checkpoint in {}", self.out.display());
        Ok(ExitCode::SUCCESS)
    }
}
