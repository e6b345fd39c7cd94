//! What a policy holds: for monitoring, logs and replays.

use std::path::Path;

use rcwm_models::bundle::Manifest;

use super::calls::{Call, CallKind, CallOutcome};
use super::{ActionLimits, Buffers, Policy, PolicyError, State};

impl Policy {
    /// The state carried into the next tick: posterior z and h of every branch.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Carries on from another state.
    ///
    /// # Errors
    /// [`PolicyError::Observation`] when its sizes are not the model's, or it holds a class that does not exist or a number that is not
    /// finite: what is carried on enters the parts as it is.
    pub fn set_state(&mut self, state: &State) -> Result<(), PolicyError> {
        if !state.same_sizes(&self.initial) {
            return Err(PolicyError::Observation("the state is of another model's size".into()));
        }
        if !state.is_of_classes(self.manifest.model.as_ref().map_or(0, |model| model.classes)) {
            let what = "the state holds a class that does not exist, or a number that is not finite";
            return Err(PolicyError::Observation(what.into()));
        }
        self.state.clone_from(state);
        self.ahead = None;
        self.calls.note(CallKind::SetState, None, CallOutcome::StateSet { checksum: state.checksum() });
        Ok(())
    }

    /// Every value of the last tick, for monitoring and for checking.
    #[must_use]
    pub fn buffers(&self) -> &Buffers {
        &self.buffers
    }

    /// Uses this noise in the ticks that follow instead of its own: Gumbel noise `[2, n, m]` of each branch, flat.
    ///
    /// # Errors
    /// [`PolicyError::Observation`] when a length is not `2 n m`, or there are not as many as branches.
    pub fn set_noise(&mut self, noise: &[&[f32]]) -> Result<(), PolicyError> {
        self.ahead = None;
        self.noise.set(noise)
    }

    /// The bundle's folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// A number that no other policy of this process has.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.calls.policy()
    }

    /// Calls of [`Self::observe`], [`Self::imagine`], [`Self::work_ahead`] and [`Self::set_state`] so far.
    #[must_use]
    pub fn calls_made(&self) -> u64 {
        self.calls.made()
    }

    /// The calls from number `first` on; at most the last [`CALLS_MAX`] are remembered.
    pub fn calls_since(&self, first: u64) -> impl Iterator<Item = &Call> {
        self.calls.since(first)
    }

    /// Where the generator of [`Sampling::Sample`] stands before what the next tick draws; 0 without one.
    #[must_use]
    pub fn noise_position(&self) -> u128 {
        self.noise.position(self.ahead.is_some())
    }

    /// Goes on drawing from there; what was worked ahead is forgotten.
    pub fn set_noise_position(&mut self, position: u128) {
        self.ahead = None;
        self.noise.set_position(position);
    }

    /// The bundle's manifest.
    #[must_use]
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The bundle's limits of actions.
    #[must_use]
    pub fn limits(&self) -> ActionLimits {
        self.limits
    }
}
