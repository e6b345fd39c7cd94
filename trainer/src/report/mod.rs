//! What models can do, as one page.
//!
//! Nouns: a **part** is one thing that was measured, a policy on a task or a model on a task's trajectories. It is a JSON file in the
//! report's folder `parts`, with its pictures beside it, and says what it was measured from, its **source**. A part whose source is
//! what is asked for is not measured again. The **page** is drawn from the parts alone.
//!
//! | file | holds |
//! | --- | --- |
//! | `parts` | parts on disk |
//! | `provenance` | when, with what and on which machine |
//! | `success` | a policy in closed loop |
//! | `dynamics` | a model on recorded trajectories, and its attention |
//! | `results` | result files that were measured elsewhere |
//! | `learning` | runs that were evaluated while they learned |
//! | `pooled` | policies of several training seeds, taken together and compared |
//! | `page` | the page and `report.json` |
//! | `sections` | what stands on the page |
//! | `html` | pictures, tables and intervals in HTML |

mod draw;
mod dynamics;
mod html;
mod learning;
mod page;
mod parts;
mod pooled;
mod provenance;
mod results;
mod sections;
mod success;

pub use dynamics::{AttentionPart, AttentionSource, Dynamics, DynamicsSource, Subject, UNDISTURBED};
pub use learning::{Learning, LearningCurve, LearningPoint, LearningRun, LearningSource};
pub use page::Report;
pub use parts::{Draft, Measurement, Part, Store};
pub use pooled::{Pooled, SuccessComparison};
pub use provenance::{Provenance, shown_path, shown_words};
pub use results::{ResultEntry, Results, ResultsSource};
pub use success::{Policy, Success, SuccessFilm, SuccessSource, Tick, policies};

use std::path::PathBuf;

use rcwm_models::bundle::BundleError;
use rcwm_models::files::FileError;
use rcwm_models::lock::LockError;

use crate::checkpoint::CheckpointError;
use crate::evaluation::{ClosedLoopError, ClosedLoopResultsError, EvaluationError};
use crate::plots::PlotError;

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A folder could not be made or listed.
    #[error("report: {path}: {source}")]
    Folder { path: PathBuf, source: std::io::Error },
    /// Somebody else measures for this report.
    #[error("report: {0}")]
    Lock(#[from] LockError),
    /// A file could not be read or written.
    #[error("report: {0}")]
    File(#[from] FileError),
    /// A part is unreadable.
    #[error("report: {path}: {reason}; remove the file and measure it again")]
    Part { path: PathBuf, reason: String },
    /// A value cannot be written as JSON.
    #[error("report: {0}")]
    Json(#[source] serde_json::Error),
    /// There are no bundles.
    #[error(
        "--bundles {path} holds no bundle of a task: expected folders with a manifest.toml, named after their tasks (hammer, ...)"
    )]
    NoBundles { path: PathBuf },
    /// Two bundles would be one row.
    #[error("--bundles: there are two policies {name:?} for {task}; rename one of their folders")]
    SamePolicy {
        /// The policy's name.
        name: String,
        task: String,
    },
    /// A result file is none.
    #[error(transparent)]
    ResultsFile(#[from] ClosedLoopResultsError),
    /// A result file cannot be taken.
    #[error("--results {path}: {reason}")]
    Results { path: PathBuf, reason: String },
    /// A run cannot be taken.
    #[error("--runs {path}: {reason}")]
    Run { path: PathBuf, reason: String },
    /// A bundle was refused.
    #[error("{path}: {source}")]
    Bundle { path: PathBuf, source: Box<BundleError> },
    /// A checkpoint was refused.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A policy could not be run.
    #[error(transparent)]
    ClosedLoop(#[from] ClosedLoopError),
    /// A model could not be measured.
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    /// A picture could not be drawn.
    #[error(transparent)]
    Plot(#[from] PlotError),
}

impl ReportError {
    /// Whether Ctrl-C is why.
    #[must_use]
    pub const fn is_interrupted(&self) -> bool {
        matches!(
            self,
            Self::ClosedLoop(ClosedLoopError::Interrupted) | Self::Evaluation(EvaluationError::Interrupted)
        )
    }
}
