use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Result;
use candle_core::Device;
use rcwm_models::settings::ModelSettings;
use rcwm_trainer::checkpoint::{Checkpoint, CheckpointSettings};
use rcwm_trainer::model::agent::{self, Part};
use rcwm_trainer::spectrum::{self, Flag, MatrixSummary};
use serde::Serialize;

/// Print the parts of a model with their numbers of parameters, or the singular values of a checkpoint's weights
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer parameters --preset paper --model rcwm
  rcwm-trainer parameters --preset small --set cnn_depth=16 --json parameters.json
  rcwm-trainer parameters --checkpoint models/small

With --checkpoint every weight matrix is a line; a convolution's rows are its output channels.
  s1 s2 s3  largest singular values
  rank      effective rank, exp of the entropy of the singular values, of the smaller side
  dead      share of the rows whose norm is below 1e-3 of the median row's
  norm      root of the sum of squares
Marked are matrices of RANK 1 (s2 below a tenth of s1: what they pass on is one number), those
with more than 10 % dead units, and those that are all zero (output layers before training).")]
pub struct Parameters {
    #[command(flatten)]
    model: super::ModelArguments,
    /// Folder of a checkpoint: print its weights' singular values and effective ranks
    #[arg(long, value_name = "DIR", conflicts_with_all = ["preset", "model", "overrides"])]
    checkpoint: Option<PathBuf>,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Table<'a> {
    settings: ModelSettings,
    parts: &'a [Part],
    total: usize,
}

#[derive(Serialize)]
struct Spectra<'a> {
    checkpoint: &'a CheckpointSettings,
    matrices: &'a [MatrixSummary],
}

impl Parameters {
    pub fn run(self) -> Result<ExitCode> {
        super::prepare_json(self.json.as_deref())?;
        match &self.checkpoint {
            Some(folder) => self.weights(folder)?,
            None => self.parts()?,
        }
        Ok(ExitCode::SUCCESS)
    }

    fn parts(&self) -> Result<()> {
        let settings = self.model.settings()?;
        let parts = agent::parts(&settings)?;
        let total = parts.iter().map(|part| part.parameters).sum();
        if let Some(path) = &self.json {
            super::write_json(path, &Table { settings, parts: &parts, total })?;
        }
        rcwm_models::outln!("{:<24} {:>12}", "part", "parameters");
        for part in &parts {
            rcwm_models::outln!("{:<24} {:>12}", part.name, part.parameters);
        }
        rcwm_models::outln!("{:<24} {:>12}  ({:.1} M)", "total", total, total as f64 / 1e6);
        Ok(())
    }

    fn weights(&self, folder: &Path) -> Result<()> {
        let Checkpoint { settings, parameters } = Checkpoint::read(folder, &Device::Cpu)?;
        let matrices = spectrum::summarise(&parameters)?;
        if let Some(path) = &self.json {
            super::write_json(path, &Spectra { checkpoint: &settings, matrices: &matrices })?;
        }
        rcwm_models::outln!("{}: {}, {} updates", folder.display(), settings.preset, settings.updates);
        print(&matrices);
        Ok(())
    }
}

fn print(matrices: &[MatrixSummary]) {
    let width = matrices.iter().map(|matrix| matrix.name.len()).max().unwrap_or(0);
    rcwm_models::outln!(
        "{:<width$} {:>12} {:>9} {:>9} {:>9} {:>14} {:>6} {:>6} {:>8}",
        "matrix",
        "shape",
        "s1",
        "s2",
        "s3",
        "rank",
        "share",
        "dead",
        "norm"
    );
    for matrix in matrices {
        let shape = matrix.shape.iter().map(ToString::to_string).collect::<Vec<_>>().join("x");
        let value =
            |index| matrix.singular_values.get(index).map_or_else(String::new, |value| number(*value));
        let side = matrix.rows.min(matrix.columns);
        let flag = matrix.flag.map_or_else(String::new, |flag| format!("  <- {}", flag.label()));
        rcwm_models::outln!(
            "{:<width$} {shape:>12} {:>9} {:>9} {:>9} {:>6.1} of {side:>4} {:>4.0} % {:>4.0} % {:>8}{flag}",
            matrix.name,
            value(0),
            value(1),
            value(2),
            matrix.effective_rank,
            100.0 * matrix.rank_share,
            100.0 * matrix.dead_share,
            number(matrix.norm),
        );
    }
    let flagged = |flag| matrices.iter().filter(|matrix| matrix.flag == Some(flag)).count();
    rcwm_models::outln!(
        "{} matrices: {} of rank 1, {} with dead units, {} all zero",
        matrices.len(),
        flagged(Flag::RankOne),
        flagged(Flag::DeadUnits),
        flagged(Flag::Zero),
    );
}

/// Three digits that count, or more where they stand before the point.
fn number(value: f64) -> String {
    let digits_before = if value > 0.0 { value.log10().floor() as i32 } else { 0 };
    match usize::try_from(2 - digits_before) {
        Ok(digits) if digits <= 5 => format!("{value:.digits$}"),
        Ok(_) => format!("{value:.1e}"),
        Err(_) => format!("{value:.0}"),
    }
}
