//! Latencies as files, at the end of a run.

use std::path::PathBuf;

use clap::Args;
use rcwm_models::files::{FileError, Output, prepare_output};

/// The options of every verb that measures latencies.
#[derive(Debug, Clone, Default, Args)]
pub struct LatencyFiles {
    /// Writes the latencies of every stage into this folder, as HdrHistogram percentile files in microseconds
    #[arg(long, value_name = "DIR")]
    pub hgrm: Option<PathBuf>,
    /// Draws latency by percentile, a line a stage, into this PNG file
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
}

impl LatencyFiles {
    /// Makes sure before the work that the files can be written.
    ///
    /// # Errors
    /// [`FileError`] names the place.
    pub fn prepare(&self) -> Result<(), FileError> {
        if let Some(folder) = &self.hgrm {
            std::fs::create_dir_all(folder)
                .map_err(|source| FileError::Io { path: folder.clone(), source })?;
        }
        self.plot.as_deref().map_or(Ok(()), |file| prepare_output(file, Output::Png))
    }

    /// One line for people of each thing that was written.
    #[must_use]
    pub fn lines(&self) -> String {
        let written = [&self.hgrm, &self.plot].into_iter().flatten();
        written.map(|path| format!("latencies  {}\n", path.display())).collect()
    }
}
