use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use candle_core::Device;
use rcwm_models::files::{read_capped, write_atomic};
use rcwm_models::lock::Lock;
use rcwm_models::tensors::Tensors;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use super::metrics::scalars;
use super::tensorboard::EventFile;
use super::weight_average::WeightAverage;
use super::{Phase, TrainingError, TrainingSettings, TrainingState, curves, curves::METRICS_BYTES_MAX};
use crate::checkpoint::{self, Checkpoint, CheckpointSettings};
use crate::learning::Adam;
use crate::model::agent;
use crate::model::parameters::Parameters;

const SETTINGS_FILE: &str = "settings.toml";
const METRICS_FILE: &str = "metrics.jsonl";
const CURVES_FILE: &str = "curves.png";

/// A run's folder.
#[derive(Debug)]
pub struct Run {
    folder: PathBuf,
    metrics: File,
    events: EventFile,
    cpu: CpuTime,
    average_decay: f64,
    average: Option<WeightAverage>,
    /// Nobody else writes here.
    _lock: Lock,
}

/// Processor time of all threads that a run has taken.
#[derive(Debug, Clone, Copy)]
struct CpuTime {
    /// By earlier processes, in seconds.
    earlier: f64,
    /// This process's when it took up the run.
    begin: f64,
}

impl CpuTime {
    fn since_now(earlier: f64) -> Self {
        Self { earlier, begin: Self::of_process() }
    }

    fn of_process() -> f64 {
        let time = clock_gettime(ClockId::ProcessCPUTime);
        time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
    }

    fn seconds(self) -> f64 {
        self.earlier + Self::of_process() - self.begin
    }
}

/// Which episodes, without the place where they lie on this machine.
fn describe_data(settings: &TrainingSettings) -> String {
    let folder = settings.data.file_name().unwrap_or(settings.data.as_os_str()).to_string_lossy();
    if settings.task.is_empty() { folder.into_owned() } else { format!("{folder}, {}", settings.task) }
}

/// Where a run goes on.
#[derive(Debug)]
pub(super) enum Resume {
    /// From the beginning: it died before its first checkpoint.
    FromStart(Run),
    /// From its newest checkpoint.
    From {
        /// Its folder.
        run: Run,
        /// The weights that are trained.
        parameters: Parameters,
        /// The counters.
        state: TrainingState,
        /// The optimisers' moments, under their keys.
        moments: Tensors,
    },
}

/// Whether a checkpoint is the best one so far, and so is kept apart from the newest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Best {
    Yes,
    /// It is not.
    No,
}

impl From<bool> for Best {
    fn from(is_best: bool) -> Self {
        if is_best { Self::Yes } else { Self::No }
    }
}

impl Run {
    /// Makes the folder of a new run.
    ///
    /// # Errors
    /// [`TrainingError::Exists`] if there is a run already, or those of writing.
    pub fn create(folder: &Path, settings: &TrainingSettings) -> Result<Self, TrainingError> {
        if folder.join(SETTINGS_FILE).exists() {
            return Err(TrainingError::Exists { path: folder.to_path_buf() });
        }
        fs::create_dir_all(folder).map_err(failed(folder))?;
        let lock = Lock::take(folder)?;
        // Another one may have begun it between the two lines above, and ended.
        if folder.join(SETTINGS_FILE).exists() {
            return Err(TrainingError::Exists { path: folder.to_path_buf() });
        }
        write_atomic(&folder.join(METRICS_FILE), b"")?;
        Self::open(folder, settings, 0, lock)
    }

    /// Goes on with the run in `folder`, which must be of one of these phases and of this model.
    ///
    /// # Errors
    /// [`TrainingError::OtherPhase`], [`TrainingError::OtherModel`], or those of reading and writing.
    pub(super) fn go_on(
        folder: &Path,
        settings: &TrainingSettings,
        phases: &[Phase],
        device: &Device,
    ) -> Result<Resume, TrainingError> {
        settings.validate()?;
        if !phases.contains(&settings.phase) {
            let found = settings.phase.verb();
            return Err(TrainingError::OtherPhase { path: folder.to_path_buf(), found });
        }
        let lock = Lock::take(folder)?;
        if !Self::has_checkpoint(folder) {
            return Ok(Resume::FromStart(Self::resume(folder, settings, 0, lock)?));
        }
        let (Checkpoint { settings: stored, parameters }, state, moments) = Self::load(folder, device)?;
        if stored.model != settings.model {
            return Err(TrainingError::OtherModel);
        }
        let mut run = Self::resume(folder, settings, state.updates, lock)?;
        run.cpu.earlier = stored.cpu_seconds;
        let trained = TrainingState::trained(&agent::specs(&stored.model)?, &moments, device)?;
        let parameters = match trained {
            Some(trained) => {
                run.average = (settings.average_decay > 0.0)
                    .then(|| WeightAverage::of(parameters, settings.average_decay));
                trained
            }
            None => parameters,
        };
        Ok(Resume::From { run, parameters, state, moments })
    }

    /// Goes on with a run: metrics beyond `updates` belong to updates that were lost, and are dropped.
    ///
    /// # Errors
    /// Those of reading and writing.
    fn resume(
        folder: &Path,
        settings: &TrainingSettings,
        updates: u64,
        lock: Lock,
    ) -> Result<Self, TrainingError> {
        #[derive(Deserialize)]
        struct Line {
            update: u64,
        }
        let path = folder.join(METRICS_FILE);
        let text = read_capped(&path, METRICS_BYTES_MAX)?;
        let mut kept = String::new();
        for line in String::from_utf8_lossy(&text).lines() {
            // A line that was cut off is of an update that was lost.
            if serde_json::from_str::<Line>(line).is_ok_and(|line| line.update <= updates) {
                kept.push_str(line);
                kept.push('\n');
            }
        }
        for place in ["", "checkpoints/last", "checkpoints/best", "films"].map(|place| folder.join(place)) {
            remove_unfinished(&place).map_err(failed(&place))?;
        }
        write_atomic(&path, kept.as_bytes())?;
        Self::open(folder, settings, updates + 1, lock)
    }

    /// `first_update` is the one that this process makes first where it goes on, else 0.
    fn open(
        folder: &Path,
        settings: &TrainingSettings,
        first_update: u64,
        lock: Lock,
    ) -> Result<Self, TrainingError> {
        write_atomic(&folder.join(SETTINGS_FILE), toml::to_string(settings)?.as_bytes())?;
        let path = folder.join(METRICS_FILE);
        let metrics = OpenOptions::new().append(true).open(&path).map_err(failed(&path))?;
        let events = EventFile::begin(folder, first_update).map_err(failed(folder))?;
        Ok(Self {
            folder: folder.to_path_buf(),
            metrics,
            events,
            cpu: CpuTime::since_now(0.0),
            average_decay: settings.average_decay,
            average: None,
            _lock: lock,
        })
    }

    /// The settings of the run in `folder`.
    ///
    /// # Errors
    /// [`TrainingError::NothingToResume`] or those of reading.
    pub fn settings(folder: &Path) -> Result<TrainingSettings, TrainingError> {
        let path = folder.join(SETTINGS_FILE);
        if !path.exists() {
            let around = folder.ancestors().skip(1).take(2).find(|run| run.join(SETTINGS_FILE).exists());
            if let (Some(run), true) = (around, folder.join(checkpoint::SETTINGS_FILE).exists()) {
                let (path, run) = (folder.to_path_buf(), run.to_path_buf());
                return Err(TrainingError::InsideARun { path, run });
            }
            return Err(TrainingError::NothingToResume { path: folder.to_path_buf(), file: SETTINGS_FILE });
        }
        Ok(rcwm_models::settings::read(&path)?)
    }

    /// A run's metrics, one JSON object a line.
    #[must_use]
    pub fn metrics(folder: &Path) -> PathBuf {
        folder.join(METRICS_FILE)
    }

    /// The run's newest checkpoint.
    #[must_use]
    pub fn last(folder: &Path) -> PathBuf {
        folder.join("checkpoints").join("last")
    }

    /// Whether the run in `folder` ever saved a checkpoint; one that died before starts from the beginning.
    #[must_use]
    pub fn has_checkpoint(folder: &Path) -> bool {
        Self::last(folder).join(checkpoint::SETTINGS_FILE).exists()
    }

    /// Appends a line of metrics: an object that tells the `update` it was written after. Its numbers go to TensorBoard too.
    pub fn log(&mut self, line: &impl Serialize) -> Result<(), TrainingError> {
        let line = serde_json::to_value(line)?;
        let update = line["update"].as_u64().unwrap_or_default();
        let text = format!("{line}\n");
        self.metrics.write_all(text.as_bytes()).map_err(failed(&self.folder.join(METRICS_FILE)))?;
        self.events.scalars(update, &scalars(&line)).map_err(failed(self.events.path()))
    }

    /// Draws the curves of everything that was logged.
    pub fn draw_curves(&self, warm_up_updates: u64) -> Result<(), TrainingError> {
        curves::write(&self.folder.join(METRICS_FILE), &self.folder.join(CURVES_FILE), warm_up_updates)
    }

    /// Lets the average follow the weights, where one is kept, after update number `updates`, from 1. `trained` accepts the names of what
    /// may have moved.
    pub(super) fn ema_update(
        &mut self,
        parameters: &Parameters,
        trained: impl Fn(&str) -> bool,
        updates: u64,
    ) -> Result<(), TrainingError> {
        if self.average_decay == 0.0 {
            return Ok(());
        }
        match &mut self.average {
            Some(average) => Ok(average.ema_update(parameters, trained, updates)?),
            None => {
                self.average = Some(WeightAverage::of(parameters.copied()?, self.average_decay));
                Ok(())
            }
        }
    }

    /// What a checkpoint holds when `parameters` are trained: their average, where one is kept.
    #[must_use]
    pub fn ema_weights(&self, parameters: &Parameters) -> Parameters {
        self.average.as_ref().map_or(parameters, WeightAverage::weights).clone()
    }

    /// The average to be set by whoever keeps it elsewhere while the run learns; none where none is kept.
    pub(super) fn average_of(
        &mut self,
        parameters: &Parameters,
    ) -> Result<Option<Parameters>, TrainingError> {
        if self.average_decay == 0.0 {
            return Ok(None);
        }
        if self.average.is_none() {
            self.average = Some(WeightAverage::of(parameters.copied()?, self.average_decay));
        }
        Ok(self.average.as_ref().map(|average| average.weights().clone()))
    }

    /// Where films go; the folder is made.
    ///
    /// # Errors
    /// Those of making it.
    pub fn films(&self) -> Result<PathBuf, TrainingError> {
        let films = self.folder.join("films");
        fs::create_dir_all(&films).map_err(failed(&films))?;
        Ok(films)
    }

    /// Saves a checkpoint as the newest one, and as the best if it is: the weights, or their average where one is kept. The state is written before the weights that it goes with,
    /// and older states are removed after, so that the folder always holds a whole pair.
    pub fn save(
        &self,
        parameters: &Parameters,
        settings: &TrainingSettings,
        state: &TrainingState,
        optimisers: &[(&str, &Adam)],
        best: Best,
    ) -> Result<(), TrainingError> {
        let checkpoint = Checkpoint {
            settings: CheckpointSettings {
                format: checkpoint::FORMAT,
                preset: settings.preset.clone(),
                seed: settings.seed,
                updates: state.updates,
                data: describe_data(settings),
                cpu_seconds: self.cpu.seconds(),
                weights_sha256: String::new(),
                model: settings.model.clone(),
            },
            parameters: self.ema_weights(parameters),
        };
        if best == Best::Yes {
            checkpoint.write(&self.folder.join("checkpoints").join("best"))?;
        }
        let last = Self::last(&self.folder);
        fs::create_dir_all(&last).map_err(failed(&last))?;
        let weights_sha256 = checkpoint.weights_sha256()?;
        let trained = self.average.is_some().then_some(parameters);
        state.write(optimisers, trained, &last, &weights_sha256)?;
        checkpoint.write(&last)?;
        Ok(TrainingState::remove_others(&last, &weights_sha256)?)
    }

    /// Reads the newest checkpoint with the state and the moments that go with it.
    ///
    /// # Errors
    /// Those of reading.
    pub fn load(
        folder: &Path,
        device: &Device,
    ) -> Result<(Checkpoint, TrainingState, Tensors), TrainingError> {
        let last = Self::last(folder);
        let checkpoint = Checkpoint::read(&last, device)?;
        let (state, moments) = TrainingState::read(&last, &checkpoint.settings.weights_sha256)?;
        Ok((checkpoint, state, moments))
    }
}

/// Removes what a run that was killed had begun to write; such files never count, but take room.
fn remove_unfinished(folder: &Path) -> std::io::Result<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().starts_with(".writing-") {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

fn failed(path: &Path) -> impl FnOnce(std::io::Error) -> TrainingError {
    let path = path.to_path_buf();
    move |source| TrainingError::Folder { path, source }
}
