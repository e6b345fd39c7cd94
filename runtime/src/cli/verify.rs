//! `rcwm-runtime verify`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::shared::{self, EngineChoice};
use crate::engine::EngineSettings;
use crate::verify::{EngineReport, HalfReport, half_weights, verify, work_units};

/// Arguments of `verify`.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  rcwm-runtime verify --bundle models/bundles/hammer --engine all\n\n\
    Exits 0 if every part and the whole tick agree with the trainer, else 1.")]
pub(super) struct VerifyArguments {
    /// The bundle's folder
    #[arg(long, value_name = "DIR")]
    bundle: PathBuf,
    /// Engine; `all` leaves out ONNX Runtime where it is not installed, and says so
    #[arg(long, value_enum, default_value = "all")]
    engine: EngineChoice,
    /// Largest error of a part's output, as a share of its largest value where that is above 1
    #[arg(long, value_name = "ERROR", default_value = "1e-5")]
    tolerance: f32,
    /// Also measures what 16-bit weights (run --half-weights) change
    #[arg(long)]
    half_weights: bool,
    /// Writes everything to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report<'a> {
    bundle: &'a PathBuf,
    tolerance: f32,
    verified: bool,
    left_out: &'a Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    half_weights: Option<HalfReport>,
    engines: &'a [EngineReport],
}

pub(super) fn run(arguments: &VerifyArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    let bundle = shared::open_bundle(&arguments.bundle)?;
    let (kinds, left_out) = arguments.engine.engines()?;
    let bar = shared::progress_bar(work_units(&bundle)? * kinds.len(), "verifying", "parts and ticks");
    let mut engines = Vec::new();
    for kind in kinds {
        // As a run deploys it.
        let deployed = EngineSettings::chosen(kind, None, false)?;
        engines.push(verify(&bundle, deployed, arguments.tolerance, &mut || bar.inc(1))?);
    }
    bar.finish_and_clear();
    let half_weights = arguments.half_weights.then(|| half_weights(&bundle)).transpose()?;
    let failures: Vec<String> = engines
        .iter()
        .flat_map(|engine| engine.failures.iter().map(move |failure| format!("{}: {failure}", engine.engine)))
        .collect();
    let report = Report {
        bundle: &arguments.bundle,
        tolerance: arguments.tolerance,
        verified: failures.is_empty(),
        left_out: &left_out,
        half_weights,
        engines: &engines,
    };
    shared::write_json(arguments.json.as_deref(), &report)?;
    for engine in &engines {
        rcwm_models::out!("{}", engine.text());
    }
    if let Some(reason) = &left_out {
        rcwm_models::outln!("engine ort not checked: {reason}");
    }
    if let Some(half) = &report.half_weights {
        rcwm_models::out!("{}", half.text());
    }
    if let Some(first) = failures.first() {
        let more = failures.len() - 1;
        let more = if more > 0 { format!(" (and {more} more)") } else { String::new() };
        anyhow::bail!("{} is NOT verified: {first}{more}", arguments.bundle.display());
    }
    rcwm_models::outln!("verified   {}", arguments.bundle.display());
    Ok(())
}
