//! What 16-bit weights change: the same ticks with both, from the same states and noise.

use rcwm_models::bundle::Bundle;
use rcwm_models::wire::ActionValues;
use serde::Serialize;

use super::VerifyError;
use super::golden::Golden;
use crate::compile::Optimizations;
use crate::engine::{EngineKind, EngineSettings, Form};
use crate::policy::{Buffers, Policy, PolicyError, Sampling, no_half_weights};

/// Ticks that are compared; golden images are shown again and again with fresh noise.
pub const HALF_TICKS: usize = 1000;

/// The effect of 16-bit weights on latents and actions.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct HalfReport {
    /// Ticks compared.
    pub ticks: usize,
    /// Latents drawn: prior and posterior of every branch.
    pub latents: usize,
    /// Those of them whose class differs.
    pub classes_differ: usize,
    /// Largest difference of the mean action.
    pub action_error_max: f32,
    /// Mean difference of the mean action.
    pub action_error_mean: f32,
}

/// Compares ticks with f32 weights and with 16-bit weights, each from the state that f32 weights gave.
///
/// # Errors
/// What the policy or the golden values say.
pub fn half_weights(bundle: &Bundle) -> Result<HalfReport, VerifyError> {
    if bundle.manifest.model.is_none() {
        return Err(PolicyError::from(no_half_weights()).into());
    }
    let golden = Golden::of(bundle)?;
    let settings = EngineSettings::single_threaded(EngineKind::Tract);
    let half = Optimizations { half_weights: true, ..Optimizations::EXACT };
    let load = |settings| Policy::new(bundle, settings, Sampling::Sample { seed: 1 });
    let (mut exact, mut half) = (load(settings)?, load(settings.with_form(Form::Compiled(half)))?);
    let mut report = HalfReport::default();
    let (mut executed, mut error_sum) = (None::<ActionValues>, 0.0_f64);
    for tick in 0..HALF_TICKS {
        let inputs = golden.inputs(tick % golden.ticks)?;
        let (right, rounded) =
            (exact.observe(inputs, executed.as_ref())?, half.observe(inputs, executed.as_ref())?);
        for (right, rounded) in right.mean.iter().zip(rounded.mean.iter()) {
            let error = (right - rounded).abs();
            report.action_error_max = report.action_error_max.max(error);
            error_sum += f64::from(error);
        }
        report.compare(exact.buffers(), half.buffers());
        half.set_state(exact.state())?;
        executed = (tick % 50 != 49).then_some(right.action);
    }
    report.ticks = HALF_TICKS;
    report.action_error_mean =
        (error_sum / (HALF_TICKS * bundle.manifest.interface.action_numbers()) as f64) as f32;
    Ok(report)
}

impl HalfReport {
    fn compare(&mut self, exact: &Buffers, half: &Buffers) {
        for (exact, half) in exact.branches.iter().zip(&half.branches) {
            for (exact, half) in [(&exact.prior_z, &half.prior_z), (&exact.posterior_z, &half.posterior_z)] {
                self.latents += exact.len();
                self.classes_differ += exact.iter().zip(half).filter(|(exact, half)| exact != half).count();
            }
        }
    }

    /// One line for people.
    #[must_use]
    pub fn text(&self) -> String {
        let Self { ticks, latents, classes_differ, action_error_max, action_error_mean } = self;
        format!(
            "f16 weights  {ticks} ticks from the same states and noise: {classes_differ} of {latents} classes differ ({:.3} %); mean \
             action differs by {action_error_mean:.1e}, at most {action_error_max:.1e}\n",
            100.0 * *classes_differ as f64 / *latents as f64
        )
    }
}
