//! Actor-critic learning in imagination (eq. 10-12).
//!
//! | file | holds |
//! | --- | --- |
//! | `settings` | everything that can be chosen, with the paper's values |
//! | `imagination`, `returns` | what the actor does in the model, and what comes of it |
//! | `return_range` | how large returns are |
//! | `losses`, `learner` | the two losses, and one update of actor, critic and slow critic |

mod imagination;
mod learner;
mod losses;
mod return_range;
mod returns;
mod settings;

pub use imagination::{Imagination, imagine};
pub use learner::{BehaviourGradients, BehaviourLearner, BehaviourUpdate};
pub use losses::{actor_loss, critic_loss};
pub use return_range::ReturnRange;
pub use returns::{lambda_return, step_weights};
pub use settings::BehaviourSettings;

/// How far is imagined and how the future is discounted.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Horizon {
    /// L: states of an imagination, the start included.
    pub length: usize,
    /// gamma, applied on top of the predicted continuation.
    pub discount: f64,
    /// lambda of the return.
    pub lambda: f64,
}

impl Default for Horizon {
    /// The paper's (Table 2).
    fn default() -> Self {
        Self { length: 15, discount: 0.997, lambda: 0.95 }
    }
}
