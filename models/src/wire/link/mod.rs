//! The shared-memory link: services, their settings, and both ends.
//!
//! The observation's publisher is the simulator's end, the action's publisher the controller's. A second simulator or a second
//! controller on one instance is refused; recorders may listen in on observations. Waiting spins for a configurable while
//! (about 1 us to notice), then blocks on the event service (about 100 us).

mod announce;
mod controller;
mod direction;
mod domain;
mod error;
mod memory;
mod observer;
mod simulator;

use std::time::Duration;

pub use controller::{ControllerLink, say_closed_for};
pub use domain::{forget_prefix, list_leftovers};
pub use error::LinkError;
pub use memory::shared_memory_number;
pub use observer::{ActionObserverLink, ObserverLink};
pub use simulator::{ObservationSlot, SimulatorLink};

pub(super) type Ipc = iceoryx2::prelude::ipc::Service;

/// Which link, and how to wait on it.
#[derive(Debug, Clone)]
pub struct LinkSettings {
    /// Names the pair of services; letters, digits, `-`, `_` and `.`.
    pub instance: String,
    /// Prefix of all files in shared memory: peers meet only under the same one. Tests that run side by side use their own.
    pub prefix: Option<String>,
    /// How long a wait polls before it blocks.
    pub spin: Duration,
}

impl LinkSettings {
    /// The link of `instance` with 50 us of spinning; the prefix comes from the variable `RCWM_PREFIX`, if set.
    #[must_use]
    pub fn new(instance: &str) -> Self {
        let prefix = std::env::var("RCWM_PREFIX").ok().filter(|prefix| !prefix.is_empty());
        Self { instance: instance.to_owned(), prefix, spin: Duration::from_micros(50) }
    }
}

/// What a wait ended with.
#[derive(Debug)]
pub enum Wait<T> {
    Message(T),
    /// The time was up, or a signal to the process (Ctrl-C) has cut the wait short.
    TimedOut,
    /// The peer said that it closes.
    Closed,
}

/// Signals seen since the last look.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Events {
    /// A controller has connected and asks for the current observation.
    pub hello: bool,
    /// The peer said that it closes.
    pub closed: bool,
    /// Somebody has asked for the interface, and was told.
    pub asked: bool,
}

#[cfg(test)]
pub(in crate::wire) mod tests;
