//! Whether a robot fits a bundle, and a bundle its own interface.

use super::{BundleError, Limits, Manifest};
use crate::interface::{Action, Interface, Mismatch, mismatches};

impl Manifest {
    /// Everything in which a robot differs from what this bundle needs; empty where it fits.
    #[must_use]
    pub fn mismatches(&self, robot: &Interface) -> Vec<Mismatch> {
        let inputs: Vec<&str> = self.policy.inputs.iter().map(String::as_str).collect();
        mismatches(&self.interface, &inputs, robot)
    }
}

impl Manifest {
    /// The smallest and the largest values of the policy's actions, in units.
    #[must_use]
    pub fn limits(&self) -> Limits {
        let all = |of: fn(&Action) -> &Vec<f64>| {
            self.interface.action.iter().flat_map(of).map(|x| *x as f32).collect()
        };
        let widest = || Limits { low: all(|action| &action.low), high: all(|action| &action.high) };
        self.policy.limits.clone().unwrap_or_else(widest)
    }

    /// The sizes of what the policy reads must be those of the model.
    pub(super) fn check_inputs(&self) -> Result<(), BundleError> {
        let (model, mut cameras, mut numbers) = (&self.model, 0, 0);
        for name in &self.policy.inputs {
            if let Some(camera) = self.interface.camera.iter().find(|camera| camera.name == *name) {
                cameras += 1;
                let needed = [model.image_side, model.image_side, 3];
                if camera.shape != needed {
                    return Err(BundleError::Invalid(format!(
                        "camera {name} is {:?}, the model sees {needed:?}",
                        camera.shape
                    )));
                }
            } else if let Some(range) = self.interface.state_range(name) {
                numbers += range.len();
            } else {
                return Err(BundleError::Invalid(format!(
                    "policy.inputs: {name:?} is no camera or state of the interface"
                )));
            }
        }
        let (needed, found) = ((model.cameras, model.state), (cameras, numbers));
        if needed != found {
            return Err(BundleError::Invalid(format!(
                "policy.inputs name {} cameras and states of {} numbers, the model reads {} and {}",
                found.0, found.1, needed.0, needed.1
            )));
        }
        Ok(())
    }

    pub(super) fn check_limits(&self) -> Result<(), BundleError> {
        let Some(Limits { low, high }) = &self.policy.limits else { return Ok(()) };
        let numbers = self.interface.action_numbers();
        if low.len() != numbers || high.len() != numbers {
            let found = (low.len(), high.len());
            return Err(BundleError::Invalid(format!(
                "policy.limits: {found:?} numbers, expected {numbers} each"
            )));
        }
        let widest = self.interface.action.iter().flat_map(|action| action.low.iter().zip(&action.high));
        for ((low, high), (lowest, highest)) in low.iter().zip(high).zip(widest) {
            // Written so that NaN fails.
            if !(*low >= *lowest as f32 && *high <= *highest as f32 && low < high) {
                return Err(BundleError::Invalid(format!(
                    "policy.limits: {low} to {high}, expected low < high, both within the interface's {lowest} to {highest}"
                )));
            }
        }
        Ok(())
    }
}
