use std::path::{Path, PathBuf};

use rcwm_models::files::{FileError, read_capped};
use serde::{Deserialize, Serialize};

use super::ClosedLoopReport;

/// Largest file of results that is read, in bytes.
const BYTES_MAX: u64 = 256 << 20;

/// Why a file of results could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ClosedLoopResultsError {
    /// It is missing, unreadable or too large.
    #[error("results: {0}")]
    File(#[from] FileError),
    /// It holds something else.
    #[error("{path}: {source}; expected what evaluate --task ... --json FILE writes")]
    Json { path: PathBuf, source: serde_json::Error },
}

/// What `evaluate --task ... --json FILE` writes: one policy on some tasks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClosedLoopResults {
    /// Where the policy lay: a bundle or a checkpoint.
    pub of: Option<PathBuf>,
    /// The tasks, in the order they were run.
    pub tasks: Vec<ClosedLoopReport>,
}

impl ClosedLoopResults {
    /// Reads a file of results; also gives its bytes, for a checksum.
    pub fn read(path: &Path) -> Result<(Self, Vec<u8>), ClosedLoopResultsError> {
        let bytes = read_capped(path, BYTES_MAX)?;
        let results = serde_json::from_slice(&bytes)
            .map_err(|source| ClosedLoopResultsError::Json { path: path.to_path_buf(), source })?;
        Ok((results, bytes))
    }
}
