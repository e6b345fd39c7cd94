//! A tick between the loop and the writer.

use rcwm_models::wire::{Action, Observation};

use super::record::BundleIdentity;
use crate::controller::TickTimes;
use crate::policy::{CALLS_MAX, Call, Policy, State};

/// A tick on its way to the writer. Its buffers are used again and again.
pub(super) struct Slot {
    pub(super) observation: Observation,
    pub(super) observed: bool,
    pub(super) is_first: bool,
    pub(super) overtaken: bool,
    pub(super) times: TickTimes,
    pub(super) answer: Action,
    pub(super) calls: Vec<Call>,
    pub(super) resumes: bool,
    pub(super) dropped_before: u64,
    pub(super) state: State,
    pub(super) noise_position: u128,
    pub(super) other_bundle: Option<BundleIdentity>,
}

impl Slot {
    pub(super) fn new(policy: &Policy) -> Self {
        let answer = Action { answers: 0, published_ns: 0, source: 0, reserved: 0, action: [0.0; 4] };
        Self {
            observation: Observation::zeroed(),
            observed: false,
            is_first: false,
            overtaken: false,
            times: TickTimes { scheduled_ns: 0, published_ns: 0, received_ns: 0, sent_ns: 0 },
            answer,
            calls: Vec::with_capacity(CALLS_MAX),
            resumes: false,
            dropped_before: 0,
            state: policy.state().clone(),
            noise_position: 0,
            other_bundle: None,
        }
    }
}
