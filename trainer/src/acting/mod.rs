//! The policy in simulators, while it learns: all of them in lock-step, one batched decision for one observation of each.
//!
//! | file | holds |
//! | --- | --- |
//! | `filter` | one step of the world model's posterior |
//! | `policy` | decisions for several simulators, each with a state of its own |
//! | `fleet` | the simulators: observations in, actions out, episodes put together |

mod filter;
mod fleet;
mod policy;

pub use filter::filter_step;
pub use fleet::{Fleet, FleetError, Gathered, Recorded};
pub use policy::{Decision, Policy, PolicyInput};
