//! A simulator and a runtime, started beside each other.

use super::*;

/// Where the programs are.
pub(super) struct Programs {
    pub(super) simulator: PathBuf,
    pub(super) runtime: PathBuf,
}

impl Programs {
    /// Both, before either is started.
    pub(super) fn find(settings: &ClosedLoopSettings) -> Result<Self, ProcessError> {
        let named =
            |path: &Option<PathBuf>, program: Program| path.clone().map_or_else(|| program.find(), Ok);
        Ok(Self {
            simulator: named(&settings.simulator, Program::SIMULATOR)?,
            runtime: named(&settings.runtime, Program::RUNTIME)?,
        })
    }
}

/// Folders that the programs are told.
pub(super) struct StepContext<'a> {
    pub(super) bundle: &'a Path,
    /// For summaries.
    pub(super) folder: &'a Path,
    /// For recorded episodes.
    pub(super) record: Option<&'a Path>,
}

/// A shared-memory domain of this evaluation's own: nothing else that runs on the machine can meet it.
pub(super) struct Domain {
    pub(super) prefix: String,
}

impl Domain {
    pub(super) fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        Self { prefix: format!("rcwm_e{}_{count}_", std::process::id()) }
    }

    pub(super) fn link(&self, instance: &str) -> LinkSettings {
        LinkSettings { prefix: Some(self.prefix.clone()), ..LinkSettings::new(instance) }
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        forget_prefix(&self.prefix);
    }
}

/// A simulator and its runtime. The order of the fields is that in which they end: first who watches, then the simulator, which
/// tells the runtime.
pub(super) struct Pair {
    observer: ObserverLink,
    pub(super) simulator: RunningProgram,
    pub(super) runtime: RunningProgram,
    instance: String,
    first_episode: u64,
    pub(super) position: Position,
    /// Since when one side runs without the other.
    alone: Option<Instant>,
    pub(super) served: PathBuf,
    pub(super) ran: PathBuf,
}

impl Pair {
    pub(super) fn start(
        programs: &Programs,
        place: &StepContext<'_>,
        settings: &ClosedLoopSettings,
        domain: &Domain,
        number: usize,
        share: &Range<u64>,
    ) -> Result<Self, ClosedLoopError> {
        let instance = format!("evaluate-{number}");
        let (first_episode, episodes) = (share.start, share.end - share.start);
        let file = |side: &str| place.folder.join(format!("{side}-{number}.json"));
        let (served, ran) = (file("simulator"), file("runtime"));
        let observer = ObserverLink::open(domain.link(&instance))?;
        let mut command = Command::new(&programs.simulator);
        command
            .env("RCWM_PREFIX", &domain.prefix)
            .args(["serve", "--pace", "lockstep", "--policy", "remote", "--wait-controller", SILENCE_S])
            .args(["--task", &settings.task, "--instance", &instance, "--disturb", &settings.disturb])
            .args(["--layouts", &settings.layouts, "--seed", &settings.seed.to_string()])
            .args(["--first-episode", &first_episode.to_string()])
            .args(["--episodes", &episodes.to_string()])
            .args(["--steps-max", &settings.steps_max.to_string(), "--json"])
            .arg(&served);
        let simulator = RunningProgram::start(Program::SIMULATOR, &instance, command)?;
        let mut command = Command::new(&programs.runtime);
        command.env("RCWM_PREFIX", &domain.prefix).args([
            "run",
            "--instance",
            &instance,
            "--engine",
            &settings.engine,
            "--timeout",
            SILENCE_S,
        ]);
        if settings.sample {
            command.args(["--sample", "--seed", &settings.seed.to_string()]);
        }
        command.arg("--bundle").arg(place.bundle).arg("--json").arg(&ran);
        if let Some(record) = place.record {
            command.arg("--record").arg(record);
        }
        let runtime = RunningProgram::start(Program::RUNTIME, &instance, command)?;
        let position = Position::default();
        Ok(Self { observer, simulator, runtime, instance, first_episode, position, alone: None, served, ran })
    }

    /// Whether either side still runs.
    pub(super) fn is_running(&mut self) -> Result<bool, ClosedLoopError> {
        if let Wait::Message(observation) = self.observer.wait_observation(Duration::ZERO)? {
            let episodes = observation.episode.saturating_sub(self.first_episode);
            self.position = Position { episodes, steps: observation.step };
        }
        let (serves, controls) = (self.simulator.is_running()?, self.runtime.is_running()?);
        // Who has said goodbye may need a while to end.
        if serves == controls {
            self.alone = None;
        } else if self.alone.get_or_insert_with(Instant::now).elapsed() > GRACE {
            let instance = self.instance.clone();
            return Err(if serves {
                ClosedLoopError::Left { instance }
            } else {
                ClosedLoopError::Hangs { instance }
            });
        }
        Ok(serves || controls)
    }
}

pub(super) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, ClosedLoopError> {
    let bytes = read_capped(path, SUMMARY_BYTES_MAX)?;
    serde_json::from_slice(&bytes)
        .map_err(|source| ClosedLoopError::Summary { path: path.to_path_buf(), source })
}
