//! What is carried from tick to tick.

use rcwm_models::bundle::InitialState;

/// How far what was observed is from what was expected, per branch: `KL[q || p]` of posterior against prior in nats, summed over
/// the categoricals. The robot's says "my arm does not move as I expect", the environment's "the scene changed".
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct Surprise {
    /// Robot branch.
    pub robot: f32,
    /// Environment branch.
    pub environment: f32,
}

#[derive(Debug, PartialEq, Default)]
pub struct BranchState {
    /// Posterior z: n class indices.
    pub z: Vec<i64>,
    /// h, d long.
    pub h: Vec<f32>,
}

/// State of both branches.
#[derive(Debug, PartialEq, Default)]
pub struct State {
    pub robot: BranchState,
    pub environment: BranchState,
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
        Self { robot: self.robot.clone(), environment: self.environment.clone() }
    }

    fn clone_from(&mut self, source: &Self) {
        self.robot.clone_from(&source.robot);
        self.environment.clone_from(&source.environment);
    }
}

impl From<&InitialState> for State {
    fn from(initial: &InitialState) -> Self {
        let branch = |z: &[i64], h: &[f32]| BranchState { z: z.to_vec(), h: h.to_vec() };
        Self {
            robot: branch(&initial.robot_z, &initial.robot_h),
            environment: branch(&initial.environment_z, &initial.environment_h),
        }
    }
}

impl State {
    /// CRC-32C over the bits of z and h of both branches, to tell the states of one run apart.
    #[must_use]
    pub fn checksum(&self) -> u32 {
        let branches = [&self.robot, &self.environment];
        branches.into_iter().fold(0, |sum, branch| {
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
        is_sound(&self.robot) && is_sound(&self.environment)
    }

    pub(super) fn same_sizes(&self, other: &Self) -> bool {
        let sizes =
            |s: &Self| [s.robot.z.len(), s.robot.h.len(), s.environment.z.len(), s.environment.h.len()];
        sizes(self) == sizes(other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_tells_the_sign_of_zero_and_the_branches_apart() {
        let branch = |h: f32| BranchState { z: vec![1, 2], h: vec![h, 0.5] };
        let state = |robot, environment| State { robot: branch(robot), environment: branch(environment) };
        let sums = [state(0.0, 1.0), state(-0.0, 1.0), state(1.0, 0.0)].map(|state| state.checksum());
        assert_eq!(sums[0], state(0.0, 1.0).checksum());
        assert!(sums[0] != sums[1] && sums[0] != sums[2] && sums[1] != sums[2]);
    }
}
