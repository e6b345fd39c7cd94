//! Sizes of an update and of its states.

use rcwm_models::settings::{ModelKind, ModelSettings};

use crate::layers::Draw;

/// Sizes of a batch and of the model.
#[derive(Debug, Clone, PartialEq)]
pub struct Sizes {
    pub model: ModelSettings,
    /// B, sequences.
    pub batch: usize,
    /// T, steps of a sequence.
    pub length: usize,
    /// Of so many steps one is decoded.
    pub decode_every: usize,
    /// Whether draws are the most probable class and actions the mean, without noise: for comparisons.
    pub mode: bool,
    /// Whether the encoders see other pictures than those that are decoded.
    pub looks: bool,
}

impl Sizes {
    /// B T.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.batch * self.length
    }

    /// Rows that are decoded.
    #[must_use]
    pub fn decoded(&self) -> usize {
        self.batch * self.length / self.decode_every
    }

    /// Branches of the model.
    #[must_use]
    pub fn branches(&self) -> usize {
        match self.model.kind {
            ModelKind::Rcwm => 2,
            ModelKind::Vanilla => 1,
        }
    }

    /// n m.
    #[must_use]
    pub fn z(&self) -> usize {
        self.model.stoch_width()
    }

    /// Columns of a branch's z and h in the features.
    #[must_use]
    pub fn columns(&self, branch: usize) -> (std::ops::Range<usize>, std::ops::Range<usize>) {
        let (z, h) = (self.z(), self.model.deter);
        let from = branch * (z + h);
        (from..from + z, from + z..from + z + h)
    }

    /// Columns of the features.
    #[must_use]
    pub fn state(&self) -> usize {
        self.branches() * (self.z() + self.model.deter)
    }

    /// Draws of z a step of the scan.
    #[must_use]
    pub fn draws(&self) -> usize {
        2 * self.branches() - 1
    }

    /// Words of noise that the update takes; the CPU draws the last prior of all rows too, which no loss needs.
    #[must_use]
    pub fn words(&self) -> u64 {
        ((self.draws() + 1) * self.rows() * self.z()) as u64
    }

    /// Draws of this model's categoricals.
    #[must_use]
    pub fn draw(&self, major: Option<(usize, usize)>) -> Draw {
        Draw { classes: self.model.classes, unimix: self.model.unimix as f32, major, of_mode: false }
    }
}
