use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rcwm_models::episode::STEPS_MAX;
use rcwm_models::programs::{MissingProgram, Program};
use rustix::process::{Pid, Signal, kill_process};

use super::LEARNING;

/// How long a simulator may take to end by itself before it is killed.
const GRACE: Duration = Duration::from_secs(5);
/// How much of a program's last words is read.
const LAST_WORDS_BYTES: u64 = 4096;

/// Why a program of this project could not be run.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The program is nowhere.
    #[error(transparent)]
    Missing(#[from] MissingProgram),
    /// It could not be started.
    #[error("starting {path}: {source}")]
    Start {
        /// The program.
        path: PathBuf,
        source: std::io::Error,
    },
    /// It ended before its work was done.
    #[error("{name} of {instance:?} ended early ({status}): {last_words}")]
    Ended {
        /// The program's name.
        name: &'static str,
        /// Its link.
        instance: String,
        /// How it ended.
        status: ExitStatus,
        /// The last line it wrote.
        last_words: String,
    },
    /// Nothing is known about it any more.
    #[error("waiting for {name} of {instance:?}: {source}")]
    Wait {
        /// The program's name.
        name: &'static str,
        /// Its link.
        instance: String,
        source: std::io::Error,
    },
}

/// What a simulator is to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Launch {
    /// Name of the task.
    pub task: String,
    /// Name of the link.
    pub instance: String,
    /// The set of layouts: one of [`LAYOUTS`](super::LAYOUTS).
    pub layouts: String,
    /// Seed of layouts, scripted decisions and disturbances.
    pub seed: u64,
    /// Number of the first episode.
    pub first_episode: u64,
    /// How many episodes; 0 until stopped.
    pub episodes: u64,
    /// Decisions in an episode.
    pub steps_max: u32,
    /// `remote`, `expert`, `random` or `mixed`.
    pub policy: &'static str,
    /// Whether the robot's mask is rendered.
    pub masks: bool,
    /// One of [`DISTURBANCES`](super::DISTURBANCES).
    pub disturb: String,
    /// The simulator's path; where there is none it is searched for.
    pub program: Option<PathBuf>,
    /// Ends by itself after so long without an answer: a trainer that was killed leaves no simulator behind.
    pub silence_max: Duration,
}

impl Launch {
    /// Endless episodes of a task on layouts to learn from, for a remote policy, without masks.
    #[must_use]
    pub fn remote(task: &str, instance: &str, seed: u64) -> Self {
        Self {
            task: task.to_owned(),
            instance: instance.to_owned(),
            layouts: LEARNING.to_owned(),
            seed,
            first_episode: 0,
            episodes: 0,
            steps_max: STEPS_PER_EPISODE,
            policy: "remote",
            masks: false,
            disturb: "none".to_owned(),
            program: None,
            silence_max: Duration::from_secs(600),
        }
    }
}

/// Decisions of a whole episode: 500 environment steps with action repeat 2.
pub(crate) const STEPS_PER_EPISODE: u32 = 250;
const _: () = assert!((STEPS_PER_EPISODE as usize) < STEPS_MAX);

/// A running simulator; it is ended when this is dropped.
#[derive(Debug)]
pub struct SimulatorProcess(RunningProgram);

impl SimulatorProcess {
    /// Starts a simulator in lock-step.
    ///
    /// # Errors
    /// [`ProcessError::Missing`] or [`ProcessError::Start`].
    pub fn start(launch: &Launch) -> Result<Self, ProcessError> {
        let mut command = Command::new(match &launch.program {
            Some(path) => path.clone(),
            None => Program::SIMULATOR.find()?,
        });
        command
            .args(["serve", "--pace", "lockstep", "--task", &launch.task, "--instance", &launch.instance])
            .args(["--policy", launch.policy, "--disturb", &launch.disturb])
            .args(["--layouts", &launch.layouts, "--seed", &launch.seed.to_string()])
            .args(["--first-episode", &launch.first_episode.to_string()])
            .args(["--episodes", &launch.episodes.to_string()])
            .args(["--steps-max", &launch.steps_max.to_string()])
            .args(["--wait-controller", &launch.silence_max.as_secs().to_string()])
            .args(launch.masks.then_some("--masks"));
        RunningProgram::start(Program::SIMULATOR, &launch.instance, command).map(Self)
    }

    /// Name of its link.
    #[must_use]
    pub fn instance(&self) -> &str {
        &self.0.instance
    }

    /// Whether it still runs; otherwise it has ended well.
    ///
    /// # Errors
    /// [`ProcessError::Ended`] with its last words if it failed.
    pub fn is_running(&mut self) -> Result<bool, ProcessError> {
        self.0.is_running()
    }
}

/// A running program of this project; it is ended when this is dropped.
#[derive(Debug)]
pub struct RunningProgram {
    child: Child,
    name: &'static str,
    instance: String,
    words: File,
}

impl RunningProgram {
    /// Starts a command of `program` on the link `instance`; what it says is kept for its last words.
    ///
    /// # Errors
    /// [`ProcessError::Start`].
    pub fn start(program: Program, instance: &str, mut command: Command) -> Result<Self, ProcessError> {
        let path = PathBuf::from(command.get_program());
        let fail = |source| ProcessError::Start { path: path.clone(), source };
        // A file, not a pipe: a pipe that nobody reads would stop it one day.
        let words = tempfile::tempfile().map_err(fail)?;
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(words.try_clone().map_err(fail)?);
        in_own_group(&mut command);
        let child = command.spawn().map_err(fail)?;
        Ok(Self { child, name: program.name, instance: instance.to_owned(), words })
    }

    /// Whether it still runs; otherwise it has ended well.
    ///
    /// # Errors
    /// [`ProcessError::Ended`] with its last words if it failed.
    pub fn is_running(&mut self) -> Result<bool, ProcessError> {
        match self.child.try_wait() {
            Ok(Some(status)) if !status.success() => Err(ProcessError::Ended {
                name: self.name,
                instance: self.instance.clone(),
                status,
                last_words: self.last_words(),
            }),
            Ok(status) => Ok(status.is_none()),
            Err(source) => {
                Err(ProcessError::Wait { name: self.name, instance: self.instance.clone(), source })
            }
        }
    }

    fn last_words(&mut self) -> String {
        let read = |file: &mut File| -> std::io::Result<String> {
            let len = file.seek(SeekFrom::End(0))?;
            file.seek(SeekFrom::Start(len.saturating_sub(LAST_WORDS_BYTES)))?;
            let mut bytes = Vec::new();
            file.take(LAST_WORDS_BYTES).read_to_end(&mut bytes)?;
            Ok(String::from_utf8_lossy(&bytes).into_owned())
        };
        let text = read(&mut self.words).unwrap_or_default();
        text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("it said nothing").trim().to_owned()
    }

    fn is_gone(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    fn wait(&mut self, longest: Duration) -> bool {
        let start = Instant::now();
        while start.elapsed() < longest {
            if self.is_gone() {
                return true;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        false
    }
}

/// Ctrl-C in a terminal goes to a whole group: the simulator is stopped by the trainer, after the trainer's last action.
fn in_own_group(command: &mut Command) {
    use std::os::unix::process::CommandExt;
    command.process_group(0);
}

impl Drop for RunningProgram {
    fn drop(&mut self) {
        if self.is_gone() {
            return;
        }
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            // It may have ended meanwhile: nothing is left to stop then.
            let _ = kill_process(pid, Signal::TERM);
        }
        if !self.wait(GRACE) {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}
