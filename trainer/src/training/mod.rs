//! Training runs.
//!
//! A run is a folder:
//!
//! ```text
//! settings.toml        everything that was chosen, resolved; --resume goes on from it
//! metrics.jsonl        one line for every `metrics_every` updates, one on the held-out episodes for every checkpoint: the truth
//! events.out.tfevents  the same numbers for TensorBoard; a resumed run begins another file
//! curves.png           the same numbers as curves, drawn anew with every checkpoint
//! checkpoints/last/    weights (their running average where `average_decay` is above 0), settings and the state of training: the newest
//! checkpoints/best/    the one with the lowest loss on the held-out episodes; where there are none, with the lowest mask-free loss
//!                      over an interval between checkpoints
//! films/               what the model imagines of one (held-out) episode a task: 000500-reach.png with every checkpoint, and animated
//!                      reach.gif of the newest
//! ```
//!
//! Every draw is numbered by its update, so the state of a run is: weights, moments of the optimiser, number of updates. A run
//! that was interrupted and resumed gives the same weights, bit for bit, as one that was not, for a fixed number of threads.
//!
//! | file | holds |
//! | --- | --- |
//! | `settings` | what can be chosen, presets |
//! | `state` | what a checkpoint holds beside the weights |
//! | `run` | the folder: settings, metrics, checkpoints |
//! | `update_loop` | what all phases do alike: updates, lines of metrics, checkpoints |
//! | `weight_average` | what checkpoints hold of the weights |
//! | `metrics` | what a line of metrics says |
//! | `tensorboard` | event files |
//! | `curves` | the metrics as a picture |
//! | `film` | films of the open loop |
//! | `held_out` | the loss on episodes that are not trained on |
//! | `pretrain` | the first phase: mask warm-up, then mask-free updates |
//! | `phases` | what can be chosen for the phases that learn a task |
//! | `reset` | what such a phase starts from |
//! | `demonstrations`, `fewshot` | a task from recorded successes alone |
//! | `prefill`, `finetune` | acting and learning, after pre-training or from scratch |
//! | `averages`, `online` | their lines of metrics and their progress |

mod averages;
mod compute;
mod curves;
mod demonstrations;
mod evaluations;
mod fewshot;
mod film;
mod finetune;
mod held_out;
mod metrics;
mod online;
mod phases;
mod prefill;
mod pretrain;
mod reset;
mod run;
mod settings;
mod state;
mod tensorboard;
mod update_loop;
mod weight_average;

pub use averages::{Averages, Interval, Line, TimeBucket};
pub use compute::Compute;
pub use curves::METRICS_BYTES_MAX;
pub use demonstrations::demonstrations;
pub use evaluations::{EvaluationFacts, EvaluationLine};
pub use fewshot::{Fewshot, Stage};
pub use film::film;
pub use finetune::Finetuning;
pub use metrics::HeldOutLosses;
pub use online::{EpisodeFacts, EpisodeLine, OnlineOutcome, OnlineProgress};
pub use phases::{EvaluationSettings, FewshotSettings, FinetuneSettings, Phase};
pub use prefill::{Prefilled, episodes_folder, prefill};
pub use pretrain::Pretraining;
pub use reset::{Reset, ResetSettings, start_from};
pub use run::{Best, Run};
pub use settings::{FilmSettings, PretrainSettings, ReplaySettings, TrainingSettings};
pub use state::{StateError, TrainingState};
pub use update_loop::{Outcome, Progress};

use crate::acting::FleetError;
use crate::checkpoint::CheckpointError;
use crate::learning::LearningError;
use crate::model::parameters::ParameterError;
use crate::plots::PlotError;
use crate::replay::{LoadError, PrefetchError, ReplayError};
use crate::simulators::CollectError;
use rcwm_models::episode::EpisodeError;
use rcwm_models::files::FileError;
use rcwm_models::lock::LockError;
use rcwm_models::settings::SettingsError;
use std::path::PathBuf;

/// Why a run ended early.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The episodes that a run is judged by could not be run.
    #[error("evaluation: {0}")]
    Evaluation(#[source] Box<crate::evaluation::ClosedLoopError>),
    /// What programs do not do.
    #[error(
        "fewshot.world_goes_on: on a GPU the world model is done when the actor begins; set it to false, or leave out --device"
    )]
    GoesOnOnGpu,
    /// The folder holds a run.
    #[error("{path} holds a run already; say --resume, or choose another folder")]
    Exists { path: PathBuf },
    /// There is nothing to resume.
    #[error("{path} holds no run to resume (no {file}); leave --resume out to start one")]
    NothingToResume {
        path: PathBuf,
        /// What is missing.
        file: &'static str,
    },
    /// The folder is one of a run's checkpoints.
    #[error("{path} is a checkpoint of a run; name the run's folder: {run}")]
    InsideARun {
        path: PathBuf,
        /// The run's.
        run: PathBuf,
    },
    /// Somebody else writes there.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// The folder holds a run of another kind.
    #[error("{path} holds a run of {found}; resume it with `rcwm-trainer {found} --resume`")]
    OtherPhase {
        path: PathBuf,
        /// What made it.
        found: &'static str,
    },
    /// No demonstration is among the data.
    #[error(
        "none of the {episodes} episodes of {task} in {path} was successful; record some: rcwm-trainer collect --task {task} --expert 50"
    )]
    NoDemonstrations {
        /// Where was looked.
        path: PathBuf,
        task: String,
        /// Episodes that were looked at.
        episodes: usize,
    },
    /// A resumed run would have another model.
    #[error("the model's sizes differ from those of the run's checkpoint; a resumed run keeps its model")]
    OtherModel,
    /// The run's folder could not be read or written.
    #[error("{path}: {source}")]
    Folder { path: PathBuf, source: std::io::Error },
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Settings are unusable.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// Settings could not be written.
    #[error("settings: {0}")]
    Serialize(#[from] toml::ser::Error),
    /// Metrics could not be written.
    #[error("metrics: {0}")]
    Json(#[from] serde_json::Error),
    /// The checkpoint is unusable or could not be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The optimiser's state is unusable or could not be written.
    #[error(transparent)]
    State(#[from] StateError),
    /// Parameters do not fit.
    #[error(transparent)]
    Parameters(#[from] ParameterError),
    /// An update failed.
    #[error(transparent)]
    Learning(#[from] LearningError),
    /// Acting in simulators failed.
    #[error(transparent)]
    Acting(#[from] FleetError),
    /// Episodes could not be collected.
    #[error(transparent)]
    Collect(#[from] CollectError),
    /// An episode could not be written.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// Data could not be loaded.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// Experience was refused or there is none.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// No batch came.
    #[error(transparent)]
    Prefetch(#[from] PrefetchError),
    /// A film or the curves could not be drawn or written.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
