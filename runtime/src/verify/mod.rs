//! A bundle against its golden values.
//!
//! **Parts.** Every part alone, on the inputs the trainer had (teacher forcing): largest absolute error of each output, against its
//! largest value where that is above 1; classes must be the same.
//!
//! **Tick.** The whole tick, over all golden ticks, carrying its own state. Classes must be the same and actions within
//! [`ACTION_TOLERANCE`]. A class may flip where the trainer's own two best were nearly equal: every flip is listed with its margin,
//! one with a margin of at most [`FLIP_MARGIN_MAX`] is accepted, and the run goes on from the trainer's state so that later
//! ticks are still compared.
//!
//! **As deployed.** Engine and threads are those that will run. With 16-bit weights the exact tick is verified first, and then the rounded
//! one from the trainer's state at every tick: it may be off by as much as rounding explains ([`HALF_ACTION_TOLERANCE`],
//! [`HALF_FLIP_MARGIN_MAX`]).

mod golden;
mod half;
mod parts;
mod recurrent;

pub use golden::Golden;
pub use half::{HALF_TICKS, HalfReport, half_weights};

use std::path::PathBuf;

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::tensors::TensorsError;
use serde::Serialize;

use crate::engine::{self, EngineError, EngineKind, EngineSettings};
use crate::policy::PolicyError;
use recurrent::Start;

/// Largest error of an action over the recurrent run.
pub const ACTION_TOLERANCE: f32 = 1e-4;
/// Largest margin between the two best classes for a flip to count as a tie.
pub const FLIP_MARGIN_MAX: f32 = 1e-4;
/// Largest error of an action from the trainer's state, with 16-bit weights: a fortieth of an action's range.
pub const HALF_ACTION_TOLERANCE: f32 = 0.05;
/// Largest margin between the two best classes, in nats, at which 16-bit weights may choose the other.
pub const HALF_FLIP_MARGIN_MAX: f32 = 0.1;

/// Why a bundle could not be verified.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// A golden value is missing or has the wrong type or size.
    #[error("{file}: {source}; export the bundle again")]
    Golden { file: PathBuf, source: TensorsError },
    /// An engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The policy failed.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// The error of one output over all ticks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OutputError {
    /// Name of the output.
    pub output: String,
    /// Ticks compared.
    pub ticks: usize,
    /// Largest absolute error; for classes the number of those that differ.
    pub error_max: f32,
    /// The golden value that is farthest from 0, or 1 if that is more: what an error is small or large against. A trained model's logits
    /// are large, and 32 bits round them accordingly. Only of values, not of classes.
    pub scale: f32,
    /// Whether it counts classes.
    pub classes: bool,
}

/// A class that is another than the trainer's.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Flip {
    pub tick: usize,
    /// `robot`, `environment` or `dynamics`.
    pub branch: PartName,
    /// `prior_z` or `posterior_z`.
    pub output: &'static str,
    /// Which of the n categoricals.
    pub categorical: usize,
    /// The trainer's class.
    pub expected: i64,
    /// The engine's class.
    pub found: i64,
    /// Difference of the trainer's two best scores.
    pub margin: f32,
    /// It follows from an earlier flip of the same tick.
    pub follows: bool,
}

impl Flip {
    /// Whether the classes were too close to tell.
    #[must_use]
    pub fn is_tie(&self) -> bool {
        self.follows || self.margin <= FLIP_MARGIN_MAX
    }
}

/// One part alone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PartReport {
    pub part: PartName,
    pub outputs: Vec<OutputError>,
    /// Classes that differ.
    pub flips: Vec<Flip>,
}

/// The whole tick.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecurrentReport {
    /// Ticks run.
    pub ticks: usize,
    /// Ticks without a flip, over which the errors below are taken.
    pub ticks_compared: usize,
    /// Largest error of the mean action.
    pub mean_error_max: f32,
    /// Largest error of the action's standard deviation; none where the policy gives none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub std_error_max: Option<f32>,
    /// Largest error of what is carried on: h of every branch.
    pub h_error_max: f32,
    /// Classes that differ.
    pub flips: Vec<Flip>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EngineReport {
    pub engine: EngineKind,
    /// Every part of the bundle that has golden values.
    pub parts: Vec<PartReport>,
    /// Parts without golden values.
    pub unchecked_parts: Vec<PartName>,
    /// The whole tick.
    pub recurrent: RecurrentReport,
    /// The whole tick with 16-bit weights, from the trainer's state each time; where they are deployed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub half_weights: Option<RecurrentReport>,
    /// What is wrong, one line each; empty when all is well.
    pub failures: Vec<String>,
}

/// Verifies a bundle in the form that `settings` deploy. `progress` is called with every unit of work done, of [`work_units`].
///
/// # Errors
/// See [`VerifyError`]. Differences are no errors but [`EngineReport::failures`].
pub fn verify(
    bundle: &Bundle,
    settings: EngineSettings,
    tolerance: f32,
    progress: &mut dyn FnMut(),
) -> Result<EngineReport, VerifyError> {
    let golden = Golden::of(bundle)?;
    let kind = settings.kind;
    engine::available(kind)?;
    let (mut parts, mut unchecked_parts) = (Vec::new(), Vec::new());
    let mut checker = parts::Checker::new(bundle, &golden, settings)?;
    let kind_of_bundle = bundle.manifest.kind;
    for part in kind_of_bundle.all_parts().filter(|part| bundle.part(*part).is_some()) {
        if golden.has(part) || kind_of_bundle.parts().contains(&part) {
            parts.push(checker.check(part, progress)?);
        } else {
            unchecked_parts.push(part);
        }
    }
    let exact = settings.with_half_weights(false);
    let recurrent = recurrent::run(bundle, &golden, exact, Start::Own, progress)?;
    let half_weights = match settings.has_half_weights() {
        true => Some(recurrent::run(bundle, &golden, settings, Start::Golden, &mut || {})?),
        false => None,
    };
    let mut failures = failures(&parts, &recurrent, tolerance);
    failures.extend(half_weights.iter().flat_map(half_failures));
    Ok(EngineReport { engine: kind, parts, unchecked_parts, recurrent, half_weights, failures })
}

/// Units of work of [`verify`] on one engine.
///
/// # Errors
/// [`VerifyError::Golden`].
pub fn work_units(bundle: &Bundle) -> Result<usize, VerifyError> {
    let ticks = Golden::of(bundle)?.ticks;
    Ok(ticks * (bundle.parts.len() + 1))
}

fn failures(parts: &[PartReport], recurrent: &RecurrentReport, tolerance: f32) -> Vec<String> {
    let mut failures = Vec::new();
    for part in parts {
        for output in part.outputs.iter().filter(|output| !output.classes) {
            let accepted = tolerance * output.scale;
            if exceeds(output.error_max, accepted) {
                let OutputError { output, error_max, .. } = output;
                failures.push(format!(
                    "{}: {output} is {error_max:.2e} off, accepted is {accepted:.1e}",
                    part.part
                ));
            }
        }
        failures.extend(clear_flips(&format!("{} alone", part.part), &part.flips));
    }
    failures.extend(clear_flips("recurrent run", &recurrent.flips));
    failures.extend(action_failures("recurrent run", recurrent, ACTION_TOLERANCE));
    failures
}

fn action_failures(run: &str, report: &RecurrentReport, tolerance: f32) -> Vec<String> {
    let std = report.std_error_max.map(|error| ("std", error));
    let errors = std::iter::once(("mean", report.mean_error_max)).chain(std);
    let wrong = errors.filter(|(_, error)| exceeds(*error, tolerance));
    wrong
        .map(|(what, error)| {
            format!("{run}: the action's {what} is {error:.2e} off, accepted is {tolerance:.0e}")
        })
        .collect()
}

/// What rounding the weights does not explain.
fn half_failures(report: &RecurrentReport) -> Vec<String> {
    let mut failures = action_failures("16-bit weights", report, HALF_ACTION_TOLERANCE);
    let clear = |flip: &&Flip| !flip.follows && exceeds(flip.margin, HALF_FLIP_MARGIN_MAX);
    if let Some(flip) = report.flips.iter().find(clear) {
        failures.push(format!(
            "16-bit weights: at tick {} {} {} is another class by a margin of {:.2e}, accepted is \
             {HALF_FLIP_MARGIN_MAX:.0e}",
            flip.tick, flip.branch, flip.output, flip.margin
        ));
    }
    failures
}

/// NaN exceeds everything.
fn exceeds(error: f32, tolerance: f32) -> bool {
    error.is_nan() || error > tolerance
}

fn clear_flips(where_: &str, flips: &[Flip]) -> Option<String> {
    let clear: Vec<_> = flips.iter().filter(|flip| !flip.is_tie()).collect();
    let worst = clear.iter().max_by(|a, b| a.margin.total_cmp(&b.margin))?;
    Some(format!(
        "{where_}: {} classes differ that are no ties (largest margin {:.2e} at tick {}, {} {})",
        clear.len(),
        worst.margin,
        worst.tick,
        worst.branch,
        worst.output
    ))
}

impl EngineReport {
    /// The report for people.
    #[must_use]
    pub fn text(&self) -> String {
        let mut text = format!("engine {}\n", self.engine);
        for part in &self.parts {
            let outputs: Vec<_> = part.outputs.iter().map(OutputError::text).collect();
            text += &format!("  {:<12} {}\n", part.part.as_str(), outputs.join("  "));
        }
        if !self.unchecked_parts.is_empty() {
            text += &format!("  no golden values: {:?}\n", self.unchecked_parts);
        }
        let r = &self.recurrent;
        text += &format!(
            "  {:<12} {} ticks, {} without a flip; mean {:.1e}  {}h {:.1e}\n",
            "whole tick",
            r.ticks,
            r.ticks_compared,
            r.mean_error_max,
            r.std_error_max.map(|error| format!("std {error:.1e}  ")).unwrap_or_default(),
            r.h_error_max
        );
        for flip in self.parts.iter().flat_map(|part| &part.flips) {
            text += &flip.text("alone");
        }
        for flip in &r.flips {
            text += &flip.text("recurrent");
        }
        text
    }
}

impl OutputError {
    fn text(&self) -> String {
        let Self { output, error_max, ticks, classes, .. } = self;
        if *classes {
            format!("{output} {error_max:.0} differ/{ticks}")
        } else {
            format!("{output} {error_max:.1e}/{ticks}")
        }
    }
}

impl Flip {
    fn text(&self, run: &str) -> String {
        let Self { tick, branch, output, categorical, expected, found, margin, .. } = self;
        let verdict = match (self.follows, self.is_tie()) {
            (true, _) => "follows from the flip before",
            (false, true) => "tie",
            (false, false) => "NOT A TIE",
        };
        format!(
            "  flip ({run}) tick {tick} {branch} {output}[{categorical}]: {expected} -> {found}, margin {margin:.1e}, \
             {verdict}\n"
        )
    }
}
