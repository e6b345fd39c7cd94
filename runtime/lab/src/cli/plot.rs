//! `rcwm-lab plot`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use rcwm_models::files::{Output, prepare_output};
use rcwm_runtime::telemetry::Stage;

use crate::plot::{Curve, plot};

/// Arguments of `plot`.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  \
    rcwm-lab plot --hgrm runs/hgrm --out runs/latency.png\n\n\
    Draws percentile files of HdrHistogram in microseconds, as run, bench and telemetry write them with --hgrm: one line a file.")]
pub(super) struct PlotArguments {
    /// Folder of the percentile files (*.hgrm)
    #[arg(long, value_name = "DIR")]
    hgrm: PathBuf,
    /// The picture
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// What stands above it
    #[arg(long, value_name = "TEXT", default_value = "latency by percentile")]
    title: String,
    /// The control period, drawn as a line
    #[arg(long, value_name = "US", value_parser = positive)]
    period_us: Option<f64>,
    /// Prints nothing where all went well
    #[arg(long)]
    quiet: bool,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("expected microseconds above 0".into()),
    }
}

pub(super) fn run(arguments: &PlotArguments) -> anyhow::Result<()> {
    prepare_output(&arguments.out, Output::Png).context("--out")?;
    let curves = read(&arguments.hgrm)?;
    plot(&arguments.out, &arguments.title, &curves, arguments.period_us)?;
    if !arguments.quiet {
        rcwm_models::outln!("drawn      {}: {} lines", arguments.out.display(), curves.len());
    }
    Ok(())
}

/// The curves of a folder: first the stages in the order of a tick, then others by name.
fn read(folder: &Path) -> anyhow::Result<Vec<Curve>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("--hgrm {}", folder.display()))?;
    let mut files: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|ending| ending == "hgrm"));
    anyhow::ensure!(
        !files.is_empty(),
        "{} holds no *.hgrm; `rcwm-runtime run --hgrm DIR` writes them",
        folder.display()
    );
    let rank = |path: &PathBuf| {
        let name = path.file_stem().unwrap_or_default().to_owned();
        (Stage::ALL.iter().position(|stage| name == stage.as_str()).unwrap_or(Stage::ALL.len()), name)
    };
    files.sort_by_key(rank);
    Ok(files.iter().map(|path| Curve::read(path)).collect::<Result<_, _>>()?)
}
