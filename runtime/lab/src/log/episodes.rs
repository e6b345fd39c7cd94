//! A log as Dreamer's episodes, so that what a deployed policy lived through is data for the trainer.

use std::path::{Path, PathBuf};

use rcwm_models::episode::{EPISODE_BYTES_MAX, Episode, EpisodeBuilder, EpisodeError};
use rcwm_models::files::{FileError, free_name, read_capped, write_new};
use rcwm_models::tasks::task_name;
use rcwm_models::wire::{Observation, ObservationFlags};

use super::ReplayError;
use rcwm_runtime::log::{Entry, LogError, LogReader};

/// What came of a log.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct WrittenEpisodes {
    /// Files written: `FOLDER/TASK/INSTANCE-START-00000.npz` and so on, START being when the run began, in seconds since 1970.
    pub files: Vec<PathBuf>,
    /// Episodes that were there already, from an earlier reading of the log.
    pub present: u64,
    /// Steps in them.
    pub steps: u64,
    /// Episodes left out: observations of them were lost, they are a single observation, or too long.
    pub left_out: u64,
    /// Why the first of them was.
    pub left_out_because: Option<String>,
    /// Where the log is damaged; all before it was used.
    pub log_damage: Option<String>,
}

/// An episode of a log, as far as it has come.
pub struct LoggedEpisode {
    builder: EpisodeBuilder,
    task: &'static str,
    next_step: u32,
    /// Why it is no episode.
    refused: Option<EpisodeError>,
}

/// Writes every episode of a log of which no observation was lost, one folder a task.
///
/// # Errors
/// [`LogError::Io`], or [`ReplayError::Episode`] also where the robot is one of which no episode is made.
pub fn write_episodes(
    log: &mut LogReader,
    folder: &Path,
    go_on: &mut dyn FnMut((u64, u64)) -> bool,
) -> Result<WrittenEpisodes, ReplayError> {
    let mut written = WrittenEpisodes::default();
    let name = format!("{}-{}", log.header().instance, log.header().started_unix_s);
    let finish = |running, written: &mut _| finish(running, &name, folder, written);
    let mut running: Option<LoggedEpisode> = None;
    loop {
        let entry = match log.read() {
            Ok(Some(entry)) => entry,
            Ok(None) => break,
            Err(error @ LogError::Damaged { .. }) => {
                written.log_damage = Some(error.to_string());
                break;
            }
            Err(error) => return Err(error.into()),
        };
        if let Entry::Tick(tick) = entry
            && let Some(observation) = &tick.observation
        {
            if tick.record.is_first {
                finish(running.take(), &mut written)?;
            }
            let now = running.get_or_insert_with(|| LoggedEpisode::start(&observation.view()));
            now.add(&observation.view(), tick.record.dropped_before > 0 && !tick.record.is_first);
            if observation.is(ObservationFlags::LAST) {
                finish(running.take(), &mut written)?;
            }
        }
        if !go_on(log.progress_bytes()) {
            break;
        }
    }
    finish(running, &mut written)?;
    Ok(written)
}

impl LoggedEpisode {
    /// One that begins with this observation, which is not added yet.
    #[must_use]
    pub fn start(observation: &Observation<'_>) -> Self {
        let task = task_name(observation.task);
        Self { builder: EpisodeBuilder::new(), task, next_step: observation.step, refused: None }
    }

    /// Adds an observation; after a `gap`, another step than the next, or one that is refused it is no episode any more.
    pub fn add(&mut self, observation: &Observation<'_>, gap: bool) {
        // A transition over a gap would teach the trainer a dynamics that does not exist.
        let lost = gap || observation.step != self.next_step;
        self.next_step = observation.step.wrapping_add(1);
        if self.refused.is_some() {
            return;
        }
        self.refused = match lost {
            true => Some(EpisodeError::Order("observations were lost".into())),
            false => self.builder.push(observation).err(),
        };
        if self.refused.is_some() {
            // Nobody needs what was gathered.
            self.builder = EpisodeBuilder::new();
        }
    }

    /// The episode.
    ///
    /// # Errors
    /// Why it is none.
    pub fn finish(mut self) -> Result<Episode, EpisodeError> {
        match self.refused {
            Some(refused) => Err(refused),
            None => self.builder.finish().ok_or_else(|| EpisodeError::Order("nothing was observed".into())),
        }
    }
}

/// Writes an episode beside those of other logs, never over one; one that is there already is not written again.
fn finish(
    running: Option<LoggedEpisode>,
    name: &str,
    folder: &Path,
    written: &mut WrittenEpisodes,
) -> Result<(), ReplayError> {
    let Some(running) = running else { return Ok(()) };
    let task = running.task;
    let episode = match running.finish() {
        Ok(episode) if episode.len() > 1 => episode,
        // Nothing of this robot will ever be written.
        Err(refused @ EpisodeError::Robot { .. }) => return Err(refused.into()),
        left_out => {
            written.left_out += 1;
            let because = left_out.map_or_else(|error| error.to_string(), |_| "a single observation".into());
            written.left_out_because.get_or_insert(because);
            return Ok(());
        }
    };
    let folder = folder.join(task);
    std::fs::create_dir_all(&folder).map_err(|source| LogError::Io { path: folder.clone(), source })?;
    let number = written.files.len() as u64 + written.present;
    let path = folder.join(format!("{name}-{number:05}.npz"));
    let bytes = episode.to_bytes(&path)?;
    loop {
        let is_same = |path: &Path| read_capped(path, EPISODE_BYTES_MAX).is_ok_and(|there| there == bytes);
        let path = free_name(&path, |path| !path.exists() || is_same(path));
        match write_new(&path, &bytes) {
            Ok(()) => written.files.push(path),
            Err(FileError::Exists { .. }) if is_same(&path) => {
                written.present += 1;
                return Ok(());
            }
            // Another program was faster; the next name.
            Err(FileError::Exists { .. }) => continue,
            Err(error) => return Err(EpisodeError::from(error).into()),
        }
        written.steps += episode.len() as u64;
        return Ok(());
    }
}
