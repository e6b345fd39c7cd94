//! Whether a robot fits a bundle.

use super::Manifest;
use crate::interface::{Interface, Mismatch, mismatches};

impl Manifest {
    /// Everything in which a robot differs from what this bundle needs; empty where it fits.
    #[must_use]
    pub fn mismatches(&self, robot: &Interface) -> Vec<Mismatch> {
        let inputs: Vec<&str> = self.policy.inputs.iter().map(String::as_str).collect();
        mismatches(&self.interface, &inputs, robot)
    }
}
