//! What travels between a simulator (or a robot) and a controller, and the shared-memory link that carries it.
//!
//! Two publish-subscribe services per instance, `rcwm/<instance>/observation` and `rcwm/<instance>/action`, each with an
//! event service of the same name that wakes the other side. A message is a header of fixed size and bytes that the interface of the
//! robot lays out ([`crate::interface::Layout`]); it is written in place. Bytes
//! begin at a multiple of 8: asked for more, iceoryx2 0.10 keeps that much room for every single byte. A third service, `rcwm/<instance>/interface`, carries the
//! interface's canonical text: the robot publishes it when it opens the link and whenever it is asked, and a controller that finds
//! that its policy does not fit says why and goes.
//!
//! A conversation of two ticks in lock-step:
//!
//! ```text
//! controller                                   simulator
//!   asks                      ------------->
//!   <-- interface                                its text
//!   connects, hello           ------------->     publishes what it last observed
//!   <-- Observation { sequence: 0, FIRST }       waits
//!   Action { answers: 0 }     ------------->     steps with it
//!   <-- Observation { sequence: 1, executed: ... }
//! ```
//!
//! The observation alone is a complete transition in Dreamer's convention: the executed action led to the image.

mod action;
pub mod clock;
mod format;
pub(in crate::wire) mod link;
mod messages;
mod observation;
pub mod robot;

pub use action::{ACTION_NUMBERS_MAX, Action, ActionSource, ActionValues};
pub use format::Format;
pub use link::{
    ActionObserverLink, ControllerLink, Events, LinkError, LinkSettings, ObservationSlot, ObserverLink,
    SimulatorLink, Wait, forget_prefix, list_leftovers, say_closed_for, shared_memory_number,
};
pub use messages::{ActionHeader, CAMERAS_MAX, ObservationFlags, ObservationHeader, WIRE};
pub use observation::{Observation, ObservationMut, ObservationSample, OwnedObservation};
