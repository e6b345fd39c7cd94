mod pair;

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use rcwm_models::episode::{Episode, EpisodeError};
use rcwm_models::files::{FileError, read_capped};
use rcwm_models::programs::Program;
use rcwm_models::wire::{LinkError, LinkSettings, ObserverLink, Wait, forget_prefix};
use serde::{Deserialize, Serialize};

use super::statistics::{Interval, mean_and_std, wilson};
use crate::acting::FleetError;
use crate::model::parameters::ParameterError;
use crate::simulators::{LEARNING, ProcessError, RunningProgram};
use pair::{Domain, Pair, Programs, StepContext, read_json};

/// A simulator or runtime whose other side is gone ends by itself after so many seconds.
const SILENCE_S: &str = "120";
/// How long one side may run without the other.
const GRACE: Duration = Duration::from_secs(30);
/// Between two looks at the processes.
const LOOK: Duration = Duration::from_millis(50);
/// Largest summary of a process that is read, in bytes.
const SUMMARY_BYTES_MAX: u64 = 64 << 20;

/// Why the closed loop could not be run.
#[derive(Debug, thiserror::Error)]
pub enum ClosedLoopError {
    /// A program is missing, did not start, or failed.
    #[error(transparent)]
    Process(#[from] ProcessError),
    /// A runtime left its simulator alone.
    #[error("rcwm-runtime of {instance:?} ended long before its simulator did; run both by hand to see why")]
    Left {
        /// Their link.
        instance: String,
    },
    /// A runtime did not end.
    #[error("rcwm-runtime of {instance:?} still runs {} s after its simulator ended", GRACE.as_secs())]
    Hangs {
        /// Their link.
        instance: String,
    },
    /// The loop could not be watched.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// There is no folder for summaries.
    #[error("temporary folder: {0}")]
    Folder(#[source] std::io::Error),
    /// A summary is missing.
    #[error("summary: {0}")]
    File(#[from] FileError),
    /// A summary is unreadable.
    #[error("summary {path}: {source}; use programs of one version")]
    Summary { path: PathBuf, source: serde_json::Error },
    /// A simulator was ended from outside: a rate over what it had done would not be that of the layouts asked for.
    #[error(
        "{found} of {expected} episodes were finished, a simulator was stopped from outside; run it again"
    )]
    Short {
        /// Episodes finished.
        found: u64,
        /// Episodes asked for.
        expected: u64,
    },
    /// A recorded episode is unreadable.
    #[error("recorded {0}")]
    Episode(#[from] EpisodeError),
    /// An episode was not recorded whole.
    #[error("episode {number} was not recorded: observations of it were lost; run it again")]
    Unrecorded { number: u64 },
    /// A policy that decides in this process gave a number that is not finite.
    #[error(
        "step {step} of episode {episode}: the policy's action is not finite, so nothing was scored; choose an earlier checkpoint"
    )]
    NotFinite {
        /// The episode's number.
        episode: u64,
        step: u32,
    },
    /// Acting in this process failed.
    #[error(transparent)]
    Acting(#[from] FleetError),
    /// The model does not fit its sizes.
    #[error(transparent)]
    Model(#[from] ParameterError),
    /// The model could not be computed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
    /// It was stopped.
    #[error("interrupted; the simulators and runtimes were ended")]
    Interrupted,
}

/// What to run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClosedLoopSettings {
    /// Name of the task.
    pub task: String,
    /// Episodes in all.
    pub episodes: u64,
    /// The set of layouts: one of [`LAYOUTS`](crate::simulators::LAYOUTS). Results of before there were sets began where learning does.
    #[serde(default = "learning")]
    pub layouts: String,
    /// Layouts of the set depend on this and on an episode's number only, so that every policy meets the same ones.
    pub seed: u64,
    /// Decisions in an episode.
    pub steps_max: u32,
    /// Visual disturbance: one of [`DISTURBANCES`](crate::simulators::DISTURBANCES).
    pub disturb: String,
    /// The runtime's engine: `tract` or `ort`; `trainer` where no runtime took part.
    pub engine: String,
    /// Whether latents and actions are drawn instead of the most probable ones.
    pub sample: bool,
    /// Simulators at a time, each with a runtime.
    pub simulators: u64,
    /// The simulator's path, where it is not beside this program.
    pub simulator: Option<PathBuf>,
    /// The runtime's path, where it is not beside this program.
    pub runtime: Option<PathBuf>,
}

fn learning() -> String {
    LEARNING.to_owned()
}

/// How well a policy solves a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClosedLoopReport {
    /// What was run.
    pub settings: ClosedLoopSettings,
    /// Whole episodes.
    pub episodes: usize,
    /// Those in which the task was solved at some step.
    pub successes: usize,
    /// Their share.
    pub success_rate: f64,
    /// Wilson's 95% interval of it.
    pub interval: Interval,
    /// Mean return of an episode.
    pub return_mean: f64,
    /// Standard deviation over episodes.
    pub return_std: f64,
    /// By episode.
    pub returns: Vec<f64>,
    /// By episode.
    pub successful: Vec<bool>,
    /// Decisions.
    pub steps: u64,
    /// Of the clock, loading included.
    pub seconds: f64,
    /// What every runtime says of itself: latencies, fallbacks, imagined steps.
    pub runtimes: Vec<serde_json::Value>,
}

/// How far a simulator is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Position {
    /// Whole episodes behind it.
    pub episodes: u64,
    /// Steps of the present one.
    pub steps: u32,
}

/// The part of a simulator's summary that is read.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Served {
    pub(super) returns: Vec<f64>,
    pub(super) successful: Vec<bool>,
    pub(super) steps: u64,
}

/// Runs a bundle's policy in simulators, in lock-step, and counts its successes. `seen` hears how far each simulator is.
///
/// # Errors
/// See [`ClosedLoopError`]; every process has ended then.
pub fn closed_loop(
    bundle: &Path,
    settings: &ClosedLoopSettings,
    stop: &AtomicBool,
    mut seen: impl FnMut(&[Position]),
) -> Result<ClosedLoopReport, ClosedLoopError> {
    run(bundle, settings, &settings.shares(), None, stop, &mut seen)
}

/// Runs one episode of those that [`closed_loop`] runs with the same settings, and records it. Without sampling it is the same one,
/// step by step.
///
/// # Errors
/// See [`ClosedLoopError`]; every process has ended then.
pub fn recorded_episode(
    bundle: &Path,
    settings: &ClosedLoopSettings,
    number: u64,
    stop: &AtomicBool,
) -> Result<Episode, ClosedLoopError> {
    let folder = tempfile::tempdir().map_err(ClosedLoopError::Folder)?;
    let settings = ClosedLoopSettings { episodes: 1, ..settings.clone() };
    let share = number..number + 1;
    run(bundle, &settings, std::slice::from_ref(&share), Some(folder.path()), stop, &mut |_| ())?;
    let entries = std::fs::read_dir(folder.path()).map_err(ClosedLoopError::Folder)?;
    let file =
        entries.flatten().map(|entry| entry.path()).find(|path| path.extension() == Some("npz".as_ref()));
    Ok(Episode::read(&file.ok_or(ClosedLoopError::Unrecorded { number })?)?)
}

/// Runs a simulator and a runtime for each share of the episodes.
fn run(
    bundle: &Path,
    settings: &ClosedLoopSettings,
    shares: &[Range<u64>],
    record: Option<&Path>,
    stop: &AtomicBool,
    seen: &mut dyn FnMut(&[Position]),
) -> Result<ClosedLoopReport, ClosedLoopError> {
    let begin = Instant::now();
    let programs = Programs::find(settings)?;
    let folder = tempfile::tempdir().map_err(ClosedLoopError::Folder)?;
    let domain = Domain::new();
    let place = StepContext { bundle, folder: folder.path(), record };
    let start = |(number, share): (usize, &Range<u64>)| {
        Pair::start(&programs, &place, settings, &domain, number, share)
    };
    let mut pairs = shares.iter().enumerate().map(start).collect::<Result<Vec<_>, _>>()?;
    loop {
        if stop.load(Ordering::Relaxed) {
            return Err(ClosedLoopError::Interrupted);
        }
        let mut runs = false;
        for pair in &mut pairs {
            runs |= pair.is_running()?;
        }
        seen(&pairs.iter().map(|pair| pair.position).collect::<Vec<_>>());
        if !runs {
            break;
        }
        std::thread::sleep(LOOK);
    }
    let served = pairs.iter().map(|pair| read_json(&pair.served)).collect::<Result<Vec<Served>, _>>()?;
    let found: u64 = served.iter().map(|served| served.successful.len() as u64).sum();
    if found != settings.episodes {
        return Err(ClosedLoopError::Short { found, expected: settings.episodes });
    }
    let runtimes = pairs.iter().map(|pair| read_json(&pair.ran)).collect::<Result<_, _>>()?;
    Ok(ClosedLoopReport::new(settings.clone(), &served, runtimes, begin.elapsed()))
}

impl ClosedLoopSettings {
    /// The episodes of each simulator.
    pub(super) fn shares(&self) -> Vec<Range<u64>> {
        let simulators = self.simulators.clamp(1, self.episodes.max(1));
        let share = |number: u64| self.episodes * number / simulators;
        (0..simulators).map(|number| share(number)..share(number + 1)).collect()
    }
}

impl ClosedLoopReport {
    pub(super) fn new(
        settings: ClosedLoopSettings,
        served: &[Served],
        runtimes: Vec<serde_json::Value>,
        time: Duration,
    ) -> Self {
        let returns: Vec<f64> = served.iter().flat_map(|served| served.returns.iter().copied()).collect();
        let successful: Vec<bool> =
            served.iter().flat_map(|served| served.successful.iter().copied()).collect();
        let (episodes, successes) = (successful.len(), successful.iter().filter(|success| **success).count());
        let (return_mean, return_std) = mean_and_std(returns.iter().copied()).unwrap_or_default();
        Self {
            settings,
            episodes,
            successes,
            success_rate: successes as f64 / episodes.max(1) as f64,
            interval: wilson(successes, episodes),
            return_mean,
            return_std,
            returns,
            successful,
            steps: served.iter().map(|served| served.steps).sum(),
            seconds: time.as_secs_f64(),
            runtimes,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> ClosedLoopSettings {
        ClosedLoopSettings {
            task: "reach".into(),
            episodes: 4,
            layouts: LEARNING.into(),
            seed: 0,
            steps_max: 5,
            disturb: "none".into(),
            engine: "tract".into(),
            sample: false,
            simulators: 1,
            simulator: Some("/bin/false".into()),
            runtime: Some("/bin/true".into()),
        }
    }

    #[test]
    fn a_program_that_fails_is_one_clear_error() {
        let run = |settings: &ClosedLoopSettings| {
            closed_loop(Path::new("nowhere"), settings, &AtomicBool::new(false), |_| ()).unwrap_err()
        };
        let text = run(&settings()).to_string();
        assert!(text.contains("rcwm-simulator") && text.contains("evaluate-0"), "{text}");
        let missing = ClosedLoopSettings { simulator: Some("/no/such/program".into()), ..settings() };
        assert!(run(&missing).to_string().contains("/no/such/program"));
    }

    #[test]
    fn successes_of_several_simulators_are_counted_together() {
        let served = |returns: &[f64], successful: &[bool]| Served {
            returns: returns.to_vec(),
            successful: successful.to_vec(),
            steps: 10,
        };
        let served = [served(&[1.0, 3.0], &[true, false]), served(&[5.0, 7.0], &[true, true])];
        let report = ClosedLoopReport::new(settings(), &served, Vec::new(), Duration::from_secs(1));
        assert_eq!((report.episodes, report.successes, report.success_rate), (4, 3, 0.75));
        assert_eq!((report.return_mean, report.steps), (4.0, 20));
        assert!(report.interval.low < 0.75 && report.interval.high > 0.75);
    }
}
