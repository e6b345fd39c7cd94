//! What the loop stands on: its end of a link, and the clock by which it counts time.

use std::time::Duration;

use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{Action, ControllerLink, LinkError, ObservationSample, Wait};

/// The controller's end of a link and its clock. [`ControllerLink`] with CLOCK_MONOTONIC is what runs; a test that makes its own time
/// wraps one, so that a run is the same every time and silence costs nothing.
pub trait Transport {
    /// Now, in ns; never runs backwards.
    fn now_ns(&self) -> u64;

    /// See [`ControllerLink::wait_observation_polling`].
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    fn wait(&self, spin: Duration, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError>;

    /// See [`ControllerLink::poll_observation`].
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    fn poll(&self) -> Result<Option<ObservationSample>, LinkError>;

    /// See [`ControllerLink::send`].
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    fn send(&self, action: &Action) -> Result<u64, LinkError>;

    /// See [`ControllerLink::hello`].
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    fn hello(&self) -> Result<(), LinkError>;

    /// See [`ControllerLink::clean_up_dead_peers`].
    fn clean_up_dead_peers(&self);

    /// See [`ControllerLink::forget_robot`].
    fn forget_robot(&mut self) {}

    /// See [`ControllerLink::say_closed`].
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    fn say_closed(&self) -> Result<(), LinkError>;
}

impl Transport for ControllerLink {
    fn now_ns(&self) -> u64 {
        monotonic_ns()
    }

    fn wait(&self, spin: Duration, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        self.wait_observation_polling(spin, timeout)
    }

    fn poll(&self) -> Result<Option<ObservationSample>, LinkError> {
        self.poll_observation()
    }

    fn send(&self, action: &Action) -> Result<u64, LinkError> {
        Self::send(self, action)
    }

    fn hello(&self) -> Result<(), LinkError> {
        Self::hello(self)
    }

    fn clean_up_dead_peers(&self) {
        Self::clean_up_dead_peers(self);
    }

    fn forget_robot(&mut self) {
        Self::forget_robot(self);
    }

    fn say_closed(&self) -> Result<(), LinkError> {
        Self::say_closed(self)
    }
}
