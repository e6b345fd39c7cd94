//! Why there is no policy, or no decision.

use rcwm_models::bundle::{BundleError, PartName};

use crate::compile::CompileError;
use crate::engine::EngineError;

/// Why there is no policy, or no decision.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The bundle was refused.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// An engine could not load or run a part.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The parts could not be made into a tick.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// The second thread could not be started.
    #[error("starting the tick's second thread: {0}; use --threads 1")]
    Thread(String),
    /// Sampling was asked of a policy that gives one action and no distribution.
    #[error(
        "--sample: a policy of kind recurrent gives one action and no distribution to sample from; leave it out"
    )]
    NothingToSample,
    /// What was observed is not fit for the policy.
    #[error("observation refused: {0}")]
    Observation(String),
    /// A part gave a number that is not finite, or a class that does not exist; the carried state is unchanged.
    #[error("{part} gave a value of {output} that is not finite or not a class")]
    NotFinite { part: PartName, output: &'static str },
}
