//! What travels between a simulator (or a robot) and a controller, and the shared-memory link that carries it.
//!
//! Two publish-subscribe services per instance, `rcwm/<instance>/observation` and `rcwm/<instance>/action`, each with an
//! event service of the same name that wakes the other side. One observation is about 16.5 kB and is written in place.
//!
//! A conversation of two ticks in lock-step:
//!
//! ```text
//! controller                                   simulator
//!   connect, hello            ------------->     publishes what it last observed
//!   <-- Observation { sequence: 0, FIRST }       waits
//!   Action { answers: 0 }     ------------->     steps with it
//!   <-- Observation { sequence: 1, executed_action: ... }
//! ```
//!
//! The observation alone is a complete transition in Dreamer's convention: `executed_action` led to `image`.

pub mod clock;
mod link;
mod messages;

pub use link::{
    ActionObserverLink, ControllerLink, Events, LinkError, LinkSettings, ObservationSample, ObservationSlot,
    ObserverLink, SimulatorLink, Wait, forget_prefix, list_leftovers, say_closed_for, shared_memory_number,
};
pub use messages::{ACTION_MAX, Action, ActionSource, Observation, ObservationFlags};
