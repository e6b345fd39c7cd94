//! What is handed over and given back.

use std::ffi::c_char;

use rcwm_models::wire::ActionValues;
use rcwm_runtime::policy::Surprise;

use crate::border::growing;

/// Most numbers of an action.
pub const RCWM_ACTION_NUMBERS_MAX: usize = 64;
const _: () = assert!(RCWM_ACTION_NUMBERS_MAX == rcwm_models::wire::ACTION_NUMBERS_MAX);

/// rcwm_input.kind: a camera's picture, of bytes.
pub const RCWM_INPUT_PICTURE: u32 = 1;
/// rcwm_input.kind: a measured state, of floats.
pub const RCWM_INPUT_STATE: u32 = 2;

/// How a bundle is loaded. Zeros, but for the size, are what is usual.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct PolicyOptions {
    /// sizeof(rcwm_policy_options).
    pub size: usize,
    /// Threads of a tick, 1 or 2; 0: 2 where there are two cores.
    pub threads: u32,
    /// Not 0: the weights of layers are kept in 16 bits, which is faster where memory is slow.
    pub half_weights: u32,
}

growing!(PolicyOptions, "rcwm_policy_options", half_weights);

/// What a policy is.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct PolicyInfo {
    /// sizeof(rcwm_policy_info).
    pub size: usize,
    /// The interface that it was made for, a text as in robot.toml; valid until the policy is closed.
    pub interface_text: *const c_char,
    /// Decisions a second.
    pub rate_hz: f64,
    /// How many inputs there are: see rcwm_policy_get_input().
    pub inputs: usize,
    /// Of those, how many are pictures.
    pub pictures: usize,
    /// Of those, how many are states.
    pub states: usize,
    /// Numbers of an action.
    pub action_numbers: usize,
    /// Not 0: there is a world model, which imagines what is not observed and says how surprised it is.
    pub imagines: u32,
}

growing!(PolicyInfo, "rcwm_policy_info", imagines);

/// One thing that a policy reads.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct InputInfo {
    /// sizeof(rcwm_input).
    pub size: usize,
    /// As in the interface; valid until the policy is closed.
    pub name: *const c_char,
    /// RCWM_INPUT_PICTURE or RCWM_INPUT_STATE.
    pub kind: u32,
    /// Of a picture; each pixel is red, green and blue, a byte each.
    pub rows: u32,
    pub columns: u32,
    /// Bytes of a picture, numbers of a state.
    pub len: usize,
}

growing!(InputInfo, "rcwm_input", len);

/// A picture of the caller's: upright, row by row, red, green and blue.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Picture {
    pub bytes: *const u8,
    pub len: usize,
}

/// Numbers of the caller's, in the interface's units.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Numbers {
    pub values: *const f32,
    pub len: usize,
}

/// What a policy decided.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Decision {
    /// sizeof(rcwm_decision).
    pub size: usize,
    /// How many numbers each of the next three has.
    pub numbers: usize,
    /// To be executed: in the interface's units and within the bundle's limits.
    pub action: [f32; RCWM_ACTION_NUMBERS_MAX],
    /// Mean of the distribution that it is from, which is over [-1, 1].
    pub mean: [f32; RCWM_ACTION_NUMBERS_MAX],
    /// Its standard deviation; zeros of a policy that gives one action.
    pub deviation: [f32; RCWM_ACTION_NUMBERS_MAX],
    /// How unexpected the picture was, in nats. Of two: the robot's branch, then the environment's.
    pub surprise: [f32; 2],
    /// How many of those there are: 0 without a world model or a picture, 1, or 2.
    pub surprises: u32,
    /// Not 0: what had been worked ahead was for another action, and was done again.
    pub recomputed: u32,
    /// Not 0: the second thread was not there in time, and the first has done its share.
    pub helper_late: u32,
}

growing!(Decision, "rcwm_decision", helper_late);

impl From<&rcwm_runtime::Decision> for Decision {
    fn from(decided: &rcwm_runtime::Decision) -> Self {
        let padded = |values: &ActionValues| {
            let mut all = [0.0; RCWM_ACTION_NUMBERS_MAX];
            all[..values.len()].copy_from_slice(values);
            all
        };
        let (surprise, surprises) = match decided.surprise {
            Some(Surprise::Rcwm { robot, environment }) => ([robot, environment], 2),
            Some(Surprise::Dreamer(dynamics)) => ([dynamics, 0.0], 1),
            None => ([0.0; 2], 0),
        };
        Self {
            size: size_of::<Self>(),
            numbers: decided.action.len(),
            action: padded(&decided.action),
            mean: padded(&decided.mean),
            deviation: padded(&decided.std),
            surprise,
            surprises,
            recomputed: decided.recomputed.into(),
            helper_late: decided.helper_late.into(),
        }
    }
}
