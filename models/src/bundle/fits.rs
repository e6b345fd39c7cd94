//! Whether a robot fits a bundle, and a bundle its own interface.

use super::{BundleError, Limits, Manifest};
use crate::interface::{Action, Camera, Interface, Mismatch, mismatches};
use crate::settings::ModelSettings;

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

    /// The cameras that the policy sees, in its order.
    pub fn cameras(&self) -> impl Iterator<Item = &Camera> {
        let of = |name: &String| self.interface.camera.iter().find(move |camera| camera.name == *name);
        self.policy.inputs.iter().filter_map(of)
    }

    /// How many measured numbers the policy reads.
    #[must_use]
    pub fn measured_numbers(&self) -> usize {
        let is_camera = |name: &&String| self.interface.camera.iter().any(|camera| camera.name == **name);
        let states = self.policy.inputs.iter().filter(|name| !is_camera(name));
        states.filter_map(|name| self.interface.state_range(name)).map(|range| range.len()).sum()
    }

    /// Bytes of the pictures that the policy sees.
    #[must_use]
    pub fn image_bytes(&self) -> usize {
        self.cameras().map(|camera| camera.shape.iter().product::<usize>()).sum()
    }

    /// What the policy reads must be there.
    pub(super) fn check_inputs(&self) -> Result<(), BundleError> {
        let is_known = |name: &&String| {
            self.interface.camera.iter().any(|camera| camera.name == **name)
                || self.interface.state_range(name).is_some()
        };
        match self.policy.inputs.iter().find(|name| !is_known(name)) {
            None => {}
            Some(name) => {
                return Err(BundleError::Invalid(format!(
                    "policy.inputs: {name:?} is no camera or state of the interface"
                )));
            }
        }
        let inputs = &self.policy.inputs;
        match inputs.iter().enumerate().find(|(at, name)| inputs[..*at].contains(name)) {
            None => Ok(()),
            Some((_, name)) => {
                Err(BundleError::Invalid(format!("policy.inputs: {name:?} is there twice, expected once")))
            }
        }
    }

    /// The sizes of what the policy reads and gives must be those of the model.
    pub(super) fn check_sizes(&self, model: &ModelSettings) -> Result<(), BundleError> {
        let (numbers, expected) = (self.interface.action_numbers(), model.action);
        if numbers != expected {
            return Err(BundleError::Invalid(format!(
                "the interface has {numbers} numbers of actions, model.action = {expected}"
            )));
        }
        let needed = [model.image_side, model.image_side, 3];
        if let Some(camera) = self.cameras().find(|camera| camera.shape != needed) {
            let Camera { name, shape, .. } = camera;
            return Err(BundleError::Invalid(format!(
                "camera {name} is {shape:?}, the model sees {needed:?}"
            )));
        }
        let (needed, found) =
            ((model.cameras, model.state), (self.cameras().count(), self.measured_numbers()));
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
