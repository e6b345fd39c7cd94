//! Faults on purpose: what the controller sends when peers die, stand still, lose, delay or repeat, and when the policy breaks.
//!
//! The controller is the real binary (but for the stall, which needs an observer that sleeps), the link is the real one, the
//! images are recorded. A witness listens in on both directions and judges what it sees there, not what the controller says of itself.

mod bed;
mod experiments;
mod peer;
mod poison;
mod witness;

pub use bed::{Bed, ControllerOptions};
pub use experiments::{Experiment, Outcome};
pub use peer::{Fault, Served, serve};
pub use poison::poisoned_bundle;
pub use witness::{Published, Record, Stale, Verdict, Witness};
