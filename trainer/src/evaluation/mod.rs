//! What a model can do (spec, section 4).
//!
//! Nouns: a **trajectory** is a stretch of a recorded episode with robot masks; its first steps are the **context**, which the model
//! sees, and the rest is **imagined** with the recorded actions. A **measure** is a number a step, a **trace** all numbers of one
//! trajectory. Every model is measured on the same trajectories.
//!
//! | file | holds |
//! | --- | --- |
//! | `open_loop` | context, then imagination |
//! | `trajectories` | which stretches of which episodes |
//! | `measures` | robot dynamics error, mask overlap, reconstruction and reward error of a step |
//! | `robot_dynamics` | a model on the trajectories of a task |
//! | `report` | means, spreads and intervals; the table and the plots |
//! | `statistics` | bootstrap over episodes, Wilson's interval |
//! | `closed_loop` | success rate of the exported policy, by simulators and runtimes |
//! | `closed_loop_in_trainer` | the same of a model that no runtime deploys |
//! | `closed_loop_results` | that, in the file that `--json` writes |
//! | `film` | what was imagined, as a strip and animated |
//! | `attention` | what the environment asks of the robot while a step is imagined |

mod attention;
mod closed_loop;
mod closed_loop_in_trainer;
mod closed_loop_results;
mod film;
mod measures;
mod open_loop;
mod report;
mod robot_dynamics;
mod statistics;
mod trajectories;

pub use attention::{Attention, AttentionFilm};
pub use closed_loop::{
    ClosedLoopError, ClosedLoopReport, ClosedLoopSettings, Position, closed_loop, recorded_episode,
};
pub use closed_loop_in_trainer::{TRAINER_ENGINE, closed_loop_in_trainer};
pub use closed_loop_results::{ClosedLoopResults, ClosedLoopResultsError};
pub use film::Film;
pub use measures::{Measure, Trace, traces};
pub use open_loop::{filtered, imagined, joined, open_loop};
pub use report::{Comparison, ModelReport, OpenLoopReport, Series, TaskReport};
pub use robot_dynamics::{Latents, Measured, OpenLoopSettings, measure};
pub use statistics::{Bootstrap, Interval, mean_and_std, wilson};
pub use trajectories::{TaskTrajectories, Trajectory};

use crate::plots::PlotError;
use crate::replay::ReplayError;

/// Why a model could not be judged.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// There is nothing to measure on.
    #[error(
        "{task}: none of {episodes} masked episodes has the {length} steps of a trajectory; imagine fewer, or collect longer ones"
    )]
    NoTrajectories {
        /// The task.
        task: String,
        /// Its episodes with masks.
        episodes: usize,
        /// Steps of a trajectory.
        length: usize,
    },
    /// No episode has masks.
    #[error("none of the episodes has robot masks; collect some with masks (rcwm-trainer collect --masks)")]
    NoMasks,
    /// It was stopped.
    #[error("interrupted; nothing was written")]
    Interrupted,
    /// A batch could not be put together.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// A film or a plot could not be drawn or written.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
