use rcwm_models::settings::SettingsError;
use serde::{Deserialize, Serialize};

use crate::learning::{AdamSettings, CloningLoss};

/// A factor that changes evenly from `first` to `last` over a number of updates, and stays there.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ramp {
    /// At the first update.
    pub first: f64,
    /// At its end.
    pub last: f64,
    /// Updates from one to the other; 0 begins at the end.
    pub updates: u64,
}

impl Ramp {
    /// The factor at update `number`, from 0.
    #[must_use]
    pub fn at(&self, number: u64) -> f64 {
        if number >= self.updates {
            return self.last;
        }
        self.first + (self.last - self.first) * (number as f64 / self.updates as f64)
    }

    /// Whether it is 0 from beginning to end.
    #[must_use]
    pub fn is_zero(&self) -> bool {
        self.last == 0.0 && (self.updates == 0 || self.first == 0.0)
    }
}

/// How the actor is cloned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CloningSettings {
    /// What the distance from a demonstrated action is.
    pub loss: CloningLoss,
    /// Examples in an update.
    pub rows: usize,
    /// How often each demonstration is filtered, with other draws of z each time; the first one takes the most probable classes, as
    /// a deployed policy does.
    pub draws: u64,
    /// States from which is imagined in an update.
    pub imagination_rows: usize,
    /// Factor of the cloning loss.
    pub weight: Ramp,
    /// Factor of the actor's loss in imagination; where it is 0 nothing is imagined, and the critic does not learn.
    pub imagination_weight: Ramp,
    /// The actor's optimiser. The critic's is that of `behaviour`.
    pub actor: AdamSettings,
}

impl Default for CloningSettings {
    /// The weights are those of the few-shot phase.
    fn default() -> Self {
        Self {
            loss: CloningLoss::SquaredError,
            rows: 256,
            draws: 4,
            imagination_rows: 256,
            weight: Ramp { first: 2.0, last: 0.8, updates: 20_000 },
            imagination_weight: Ramp { first: 0.01, last: 0.2, updates: 20_000 },
            actor: AdamSettings {
                learning_rate: 1e-3,
                eps: 1e-5,
                clip_norm: 100.0,
                ..AdamSettings::default()
            },
        }
    }
}

impl CloningSettings {
    /// Checks what TOML's types do not.
    ///
    /// # Errors
    /// [`SettingsError::Invalid`] names the setting, what was found and what is accepted.
    pub fn validate(&self) -> Result<(), SettingsError> {
        for (name, value) in [
            ("rows", self.rows as u64),
            ("draws", self.draws),
            ("imagination_rows", self.imagination_rows as u64),
        ] {
            if value == 0 {
                return Err(SettingsError::Invalid(format!(
                    "fewshot.cloning.{name} = 0, expected at least 1"
                )));
            }
        }
        for (name, ramp) in [("weight", self.weight), ("imagination_weight", self.imagination_weight)] {
            if [ramp.first, ramp.last].iter().any(|x| !x.is_finite() || *x < 0.0) {
                return Err(SettingsError::Invalid(format!(
                    "fewshot.cloning.{name}: found {ramp:?}, expected factors of at least 0"
                )));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_goes_evenly_and_then_stays() {
        let ramp = Ramp { first: 2.0, last: 0.8, updates: 4 };
        let at = [0, 1, 2, 4, 900].map(|number| ramp.at(number));
        assert_eq!(at, [2.0, 1.7, 1.4, 0.8, 0.8]);
        assert_eq!(Ramp { updates: 0, ..ramp }.at(0), 0.8);
        assert!(Ramp { first: 0.0, last: 0.0, updates: 9 }.is_zero() && !ramp.is_zero());
    }
}
