//! Writes a bundle: the policy's parts as ONNX graphs, the initial state, golden values, and the manifest over them.
//!
//! The graphs use standard operators of opset 17 only. Latents travel as class indices, so that a linear layer on a one-hot is a
//! `Gather` of rows and a sum. `robot_image` and `environment_image` of the decoder are image times mask: what the
//! branch adds to the whole picture.
//!
//! The folder is built beside its place, opened and checked as a runtime would, and then put there in one step.

mod blocks;
mod branch;
mod bundle;
mod decoder;
mod golden;
mod graph;
mod heads;
mod interaction;
mod operators;
mod scene;
mod weights;

use std::path::PathBuf;

use prost::Message;
use rcwm_models::bundle::{PartName, WriteError};
use rcwm_models::episode::{EpisodeError, Misfit};
use rcwm_models::settings::ModelSettings;
use rcwm_models::tensors::TensorsError;

pub use bundle::{Options, write};

use crate::model::parameters::ParameterError;
use weights::Weights;

/// Why a bundle could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// No golden ticks.
    #[error("export: golden values need at least one tick")]
    NoTicks,
    /// The place is taken, or the folder could not be written; a finished bundle that does not open is a bug of this program.
    #[error("export: {0}")]
    Write(#[from] WriteError),
    /// The work was interrupted; nothing is left behind.
    #[error("export: interrupted; nothing was written")]
    Interrupted,
    /// The episode for the golden values is unusable.
    #[error("export: {0}")]
    Episode(#[from] EpisodeError),
    /// The episode for the golden values was recorded of another robot.
    #[error(
        "export: {path} does not fit the model: {} is {}, expected {}", misfit.key, misfit.found, misfit.expected
    )]
    Misfit { path: PathBuf, misfit: Misfit },
    /// Golden values or initial state could not be written.
    #[error("export: {0}")]
    Tensors(#[from] TensorsError),
    /// The weights do not fit the model.
    #[error("export: {0}")]
    Parameters(#[from] ParameterError),
    /// A tensor operation failed.
    #[error("export: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// Hears how far the export is, and may stop it.
pub trait Progress {
    /// Called before every step.
    ///
    /// # Errors
    /// [`ExportError::Interrupted`] stops the export.
    fn step(&self, what: &str, done: usize, total: usize) -> Result<(), ExportError>;
}

/// The ONNX file of a part.
fn part_to_onnx(name: PartName, weights: &Weights, settings: &ModelSettings) -> Vec<u8> {
    let graph = graph::Graph::new(name.as_str(), describe(name));
    let mut part = blocks::Part { graph, weights, settings };
    match name {
        PartName::Encoder => part.encoder(),
        PartName::Robot => part.robot(),
        PartName::Interaction => part.interaction(),
        PartName::Environment => part.environment(),
        PartName::Dynamics => part.dynamics(),
        // No world model is exported as one graph: `Bundle::open` refuses a part of another kind.
        PartName::Policy => {}
        PartName::Actor => part.actor(),
        PartName::Reward => part.reward(),
        PartName::Continue => part.continues(),
        PartName::Decoder => part.decoder(),
    }
    part.graph.finish().encode_to_vec()
}

fn describe(name: PartName) -> &'static str {
    match name {
        PartName::Encoder => "Shared encoder: image to features",
        PartName::Dynamics => "The one branch: one step of the recurrence, prior and posterior",
        PartName::Policy => "Policy",
        PartName::Robot => "Robot branch with its encoder: one step of the recurrence, prior and posterior",
        PartName::Interaction => "Cross-attention from the environment's state to the robot's prior",
        PartName::Environment => {
            "Environment branch with its encoder: one step of the recurrence, prior and posterior"
        }
        PartName::Actor => "Action distribution of a state",
        PartName::Reward => "Expected reward of a state",
        PartName::Continue => "Probability that the episode goes on",
        PartName::Decoder => "Pictures and masks of a state; a branch's image is multiplied by its mask",
    }
}
