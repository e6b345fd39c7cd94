//! What is carried from tick to tick.

use rcwm_models::bundle::{InitialBranch, InitialState};

#[derive(Debug, PartialEq, Default)]
pub struct BranchState {
    /// Posterior z: n class indices.
    pub z: Vec<i64>,
    /// h, d long.
    pub h: Vec<f32>,
}

/// State of all branches.
#[derive(Debug, PartialEq, Default)]
pub struct State {
    /// In the order of [`rcwm_models::bundle::BundleKind::branches`]; of a policy without a world model one, which has all carried numbers as
    /// its h.
    pub branches: Vec<BranchState>,
}

// Written out because the derived `clone_from` allocates anew.
impl Clone for BranchState {
    fn clone(&self) -> Self {
        Self { z: self.z.clone(), h: self.h.clone() }
    }

    fn clone_from(&mut self, source: &Self) {
        self.z.clone_from(&source.z);
        self.h.clone_from(&source.h);
    }
}

impl Clone for State {
    fn clone(&self) -> Self {
        Self { branches: self.branches.clone() }
    }

    fn clone_from(&mut self, source: &Self) {
        self.branches.clone_from(&source.branches);
    }
}

impl From<&InitialState> for State {
    fn from(initial: &InitialState) -> Self {
        let branch = |from: &InitialBranch| BranchState { z: from.z.clone(), h: from.h.clone() };
        Self { branches: initial.branches.iter().map(branch).collect() }
    }
}

impl State {
    /// CRC-32C over the bits of z and h of all branches, to tell the states of one run apart.
    #[must_use]
    pub fn checksum(&self) -> u32 {
        self.branches.iter().fold(0, |sum, branch| {
            let sum =
                branch.z.iter().fold(sum, |sum, class| crc32c::crc32c_append(sum, &class.to_le_bytes()));
            branch.h.iter().fold(sum, |sum, value| crc32c::crc32c_append(sum, &value.to_le_bytes()))
        })
    }

    /// Whether every z is one of this many classes, and every h finite.
    pub(super) fn is_of_classes(&self, classes: usize) -> bool {
        let exists = |class: &i64| usize::try_from(*class).is_ok_and(|class| class < classes);
        let is_sound = |branch: &BranchState| {
            branch.z.iter().all(exists) && branch.h.iter().all(|value| value.is_finite())
        };
        self.branches.iter().all(is_sound)
    }

    pub(super) fn same_sizes(&self, other: &Self) -> bool {
        let sizes = |branch: &BranchState| (branch.z.len(), branch.h.len());
        self.branches.iter().map(sizes).eq(other.branches.iter().map(sizes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_tells_the_sign_of_zero_and_the_branches_apart() {
        let branch = |h: f32| BranchState { z: vec![1, 2], h: vec![h, 0.5] };
        let state = |robot, environment| State { branches: vec![branch(robot), branch(environment)] };
        let sums = [state(0.0, 1.0), state(-0.0, 1.0), state(1.0, 0.0)].map(|state| state.checksum());
        assert_eq!(sums[0], state(0.0, 1.0).checksum());
        assert!(sums[0] != sums[1] && sums[0] != sums[2] && sums[1] != sums[2]);
    }
}
