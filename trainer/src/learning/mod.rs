//! Learning the world model: what a batch is, what is wrong with it (losses), and how the parameters follow.
//!
//! | file | holds |
//! | --- | --- |
//! | `settings` | everything that can be chosen, with the paper's values |
//! | `batch` | sequences of experience as tensors |
//! | `losses` | image, mask, reward, continuation, KL per branch (eq. 2, 3, 9) |
//! | `look` | how the encoders see what is learned from: disturbed, with other colours |
//! | `kl` | balanced KL with free bits, per branch |
//! | `gradients`, `adam` | gradients by name, clipping, the optimiser |
//! | `parts` | where the time of an update goes |
//! | `shift` | pictures that are moved by some pixels |
//! | `sides` | which parameters belong to the robot's side, the environment's, the behaviour |
//! | `world` | one update of the world model |

mod adam;
mod batch;
mod cloning_loss;
mod examples;
mod gradients;
mod kl;
mod look;
mod losses;
pub mod parts;
mod settings;
mod shift;
mod sides;
mod world;

pub use adam::{Adam, AdamSettings, Moments};
pub use batch::{Batch, HostBatch};
pub use cloning_loss::{CloningLoss, cloning_loss};
pub use examples::{Examples, Views, actions_taken, state_of_features};
pub use gradients::Gradients;
pub use kl::{BranchKl, balanced_kl};
pub use look::{Jitter, Look, LookSettings};
pub use losses::{LossValues, WorldLosses, world_losses};
pub use settings::WorldSettings;
pub use shift::Shift;
pub use sides::{Side, Trained, side_of};
pub use world::{Imitation, WorldLearner, WorldUpdate};

use crate::model::parameters::ParameterError;

/// Why an update could not be made.
#[derive(Debug, thiserror::Error)]
pub enum LearningError {
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
    /// The model could not be built on the parameters.
    #[error(transparent)]
    Parameters(#[from] ParameterError),
    /// The GPU did not do what it was asked.
    #[error(transparent)]
    Gpu(#[from] rcwm_gpu::GpuError),
    /// A parameter that is to be trained is not connected with the loss.
    #[error("no gradient reaches parameter {name}, which is to be trained: an operation on its way has none")]
    NoGradient {
        /// The parameter.
        name: String,
    },
    /// A loss or a gradient is NaN or infinite; the parameters were left as they were.
    #[error(
        "{what} is {value}: the update was not made; resume from the last checkpoint, with a lower learning rate if it \
         happens again"
    )]
    NotFinite {
        /// Which number.
        what: &'static str,
        value: f64,
    },
}
