//! Why collecting failed.

use std::path::PathBuf;

use rcwm_models::episode::EpisodeError;
use rcwm_models::lock::LockError;

use super::ClientError;

/// Why collecting failed.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// A simulator.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// An episode could not be put together or written.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// A second look at an episode was not of the same episode.
    #[error(
        "episode {path}: with the look {look} the same script did something else; it was collected with other steps, by another version, or changed. \
         Collect into an empty folder"
    )]
    OtherEpisode {
        path: PathBuf,
        /// The disturbance.
        look: String,
    },
    /// Somebody else collects into the folder.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// A folder could not be made.
    #[error("{path}: {source}")]
    Folder { path: PathBuf, source: std::io::Error },
}

impl From<super::ProcessError> for CollectError {
    fn from(error: super::ProcessError) -> Self {
        Self::Client(error.into())
    }
}
