//! What is carried from tick to tick.

use rcwm_models::bundle::InitialState;

use super::Buffers;

/// State of one branch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BranchState {
    /// Posterior z: n class indices.
    pub z: Vec<i64>,
    /// h, d long.
    pub h: Vec<f32>,
}

/// State of both branches.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct State {
    /// Robot branch.
    pub robot: BranchState,
    /// Environment branch.
    pub environment: BranchState,
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
    /// Takes over posterior z and h of the tick that is in the buffers. Copies, allocates nothing.
    pub(super) fn take_posterior(&mut self, buffers: &Buffers) {
        for (state, branch) in
            [(&mut self.robot, &buffers.robot), (&mut self.environment, &buffers.environment)]
        {
            state.z.copy_from_slice(&branch.posterior_z);
            state.h.copy_from_slice(&branch.h_next);
        }
    }

    pub(super) fn same_sizes(&self, other: &Self) -> bool {
        let sizes =
            |s: &Self| [s.robot.z.len(), s.robot.h.len(), s.environment.z.len(), s.environment.h.len()];
        sizes(self) == sizes(other)
    }
}
