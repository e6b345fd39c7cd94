//! Updates of world model, actor and critic as programs: lists of kernels and matrix products over memory that is laid out once. On a GPU a
//! program is captured as one CUDA graph and replayed, so that an update costs one launch; on the host the same kernels, compiled as C,
//! run one after the other, which is how they are tested.
//!
//! | module | holds |
//! | --- | --- |
//! | `commands`, `kernel` | what a program is made of |
//! | `program` | a list of commands, and how its buffers share memory |
//! | `machine` | where programs run: the host, or an NVIDIA GPU |
//! | `tape` | gradients: every op adds its commands forward and says what to add backward |
//! | `layers` | the model's layers on a tape |
//! | `weights` | all parameters in one flat array, with their gradients and moments |
//! | `world`, `behaviour` | the two updates |
//! | `learner` | both, with what goes in and comes out |
//!
//! Rows of sequences are time-major: row `t * B + b` is step t of sequence b.

pub mod behaviour;
pub mod commands;
pub mod kernel;
pub mod layers;
pub mod learner;
pub mod machine;
pub mod program;
pub mod tape;
pub mod weights;
pub mod world;

pub use learner::{Batch, BehaviourValues, Learner, LearnerSettings, WorldValues};
pub use machine::{GpuError, Machine, Precision};
