//! What a model can do: robot dynamics (paper, Fig. 4 and 7) and success in closed loop.
//!
//! Nouns: a **trajectory** is a stretch of a recorded episode with robot masks, a **window**; its first steps are the **context**, which
//! the model sees, and the rest is **imagined** with the recorded actions. Windows end before the task is solved and the robot moves in
//! them, unless all are asked for. A **measure** is a number a step, a **trace** all numbers of one trajectory, a **response** what
//! changes in the imagined pictures with other actions. Every model is measured on the same trajectories. Two sets of models are compared
//! over **training seeds**, each of which counts once.
//!
//! | file | holds |
//! | --- | --- |
//! | `open_loop` | context, then imagination |
//! | `recordings` | episodes with masks, and who decided in them |
//! | `motion` | which pixels change, when the robot moves |
//! | `trajectories` | which stretches of which episodes |
//! | `measures` | robot dynamics error, error on what else moves, mask overlap, reconstruction and reward error of a step |
//! | `response` | two action sequences from one start |
//! | `response_film` | both, as a strip and animated |
//! | `robot_dynamics` | a model on the trajectories of a task |
//! | `report` | means, spreads and intervals; the table and the plots |
//! | `table` | the same for people |
//! | `comparison` | one model against another on the same trajectories |
//! | `seeds` | sets of models over training seeds |
//! | `statistics` | bootstrap over episodes and over training seeds, Wilson's interval |
//! | `closed_loop` | success rate of the exported policy, by simulators and runtimes |
//! | `closed_loop_in_trainer` | the same without a runtime |
//! | `closed_loop_results` | that, in the file that `--json` writes |
//! | `film` | what was imagined, as a strip and animated |
//! | `attention` | what the environment asks of the robot while a step is imagined |
//! | `attention_spread` | the same of many states, in numbers |

mod attention;
mod attention_spread;
mod closed_loop;
mod closed_loop_in_trainer;
mod closed_loop_results;
mod comparison;
mod film;
mod measures;
mod motion;
mod open_loop;
mod open_loop_settings;
mod recordings;
mod report;
mod response;
mod response_film;
mod robot_dynamics;
mod seeds;
mod statistics;
mod table;
mod task_report;
mod trajectories;

pub use attention::{Attention, AttentionFilm, BRIGHTEST_TIMES_EVEN};
pub use attention_spread::{AttentionMaps, AttentionSpread};
pub use closed_loop::{
    ClosedLoopError, ClosedLoopReport, ClosedLoopSettings, Position, closed_loop, recorded_episode,
};
pub use closed_loop_in_trainer::{TRAINER_ENGINE, closed_loop_in_trainer};
pub use closed_loop_results::{ClosedLoopResults, ClosedLoopResultsError};
pub use comparison::{Comparison, Over};
pub use film::Film;
pub use measures::{Measure, Trace, traces};
pub use open_loop::{filtered, imagined, joined, open_loop};
pub use open_loop_settings::{Latents, OpenLoopSettings, Windows};
pub use recordings::{OTHER_KIND, Recording, Recordings};
pub use report::{ModelReport, OpenLoopReport};
pub use response::{Answer, Difference, Differences, OtherActions, Response, Share, differences};
pub use response_film::ResponseFilm;
pub use robot_dynamics::{Measured, measure};
pub use seeds::{OverSeeds, SeedGroup, SeedRow, Trained};
pub use statistics::{
    Bootstrap, Interval, SEEDS_LEAST, interval_over_seeds, mean_and_std, mean_over_seeds, wilson,
};
pub use task_report::{KindReport, Series, Spread, TaskReport};
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
        task: String,
        /// Its episodes with masks.
        episodes: usize,
        /// Steps of a trajectory.
        length: usize,
    },
    /// Nowhere does the robot move for long enough before the task is solved.
    #[error(
        "{task}: none of {episodes} masked episodes has a window of {least} steps that ends before success and in which the robot moves; see \
         or imagine fewer (--context, --imagined), collect others, or take all windows (--windows anywhere)"
    )]
    NoMovingWindows {
        task: String,
        /// Its episodes with masks.
        episodes: usize,
        /// Steps that a window must have at least.
        least: usize,
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
