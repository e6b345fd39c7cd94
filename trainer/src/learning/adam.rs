use std::collections::BTreeMap;

use candle_core::{Result, Var};
use serde::{Deserialize, Serialize};

use super::Gradients;
use crate::model::parameters::Parameters;
use crate::ops::{AdamStep, adam_step};

/// Adam with clipping by the global norm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamSettings {
    /// Step size.
    pub learning_rate: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Largest norm of all gradients together; larger ones are scaled down to it.
    pub clip_norm: f64,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
}

impl Default for AdamSettings {
    fn default() -> Self {
        Self { learning_rate: 1e-4, eps: 1e-8, clip_norm: 1000.0, beta1: 0.9, beta2: 0.999 }
    }
}

/// One parameter's moments.
#[derive(Debug, Clone)]
pub struct Moments {
    /// Average of the gradient.
    pub first: Var,
    /// Average of its square.
    pub second: Var,
    /// Steps that went into them; the bias correction is each parameter's own, as some are frozen for a while.
    pub steps: u64,
}

/// The optimiser of one loss.
#[derive(Debug, Clone)]
pub struct Adam {
    settings: AdamSettings,
    moments: BTreeMap<String, Moments>,
}

impl Adam {
    /// An optimiser that has seen nothing.
    #[must_use]
    pub fn new(settings: AdamSettings) -> Self {
        Self { settings, moments: BTreeMap::new() }
    }

    /// An optimiser that goes on from these moments.
    #[must_use]
    pub fn resumed(settings: AdamSettings, moments: BTreeMap<String, Moments>) -> Self {
        Self { settings, moments }
    }

    /// The moments of every parameter that was ever trained, by name.
    #[must_use]
    pub fn moments(&self) -> &BTreeMap<String, Moments> {
        &self.moments
    }

    /// Forgets the moments of the parameters whose names `forget` accepts: they start anew.
    pub fn forget(&mut self, forget: impl Fn(&str) -> bool) {
        self.moments.retain(|name, _| !forget(name));
    }

    /// Moves every parameter that has a gradient by one step of the settings' learning rate.
    pub fn step(&mut self, parameters: &Parameters, gradients: &Gradients) -> Result<()> {
        let rate = self.settings.learning_rate;
        self.step_at(parameters, gradients, |_| rate)
    }

    /// Moves every parameter that has a gradient by one step of its own learning rate.
    pub fn step_at(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        rate: impl Fn(&str) -> f64,
    ) -> Result<()> {
        let scale = clip_factor(gradients.norm(), self.settings.clip_norm);
        for (name, gradient) in gradients.iter() {
            let Some(parameter) = parameters.get(name) else { continue };
            if !self.moments.contains_key(name) {
                let zeros = || Var::from_tensor(&parameter.as_tensor().zeros_like()?);
                let moments = Moments { first: zeros()?, second: zeros()?, steps: 0 };
                self.moments.insert(name.to_owned(), moments);
            }
            if let Some(moments) = self.moments.get_mut(name) {
                moments.steps += 1;
                let AdamSettings { eps, beta1, beta2, .. } = self.settings;
                let step = AdamStep { number: moments.steps, scale, rate: rate(name), beta1, beta2, eps };
                adam_step(parameter, &moments.first, &moments.second, gradient, &step)?;
            }
        }
        Ok(())
    }
}

/// What gradients of this norm are multiplied with.
fn clip_factor(norm: f64, norm_max: f64) -> f64 {
    (norm_max / (norm + 1e-6)).min(1.0)
}
