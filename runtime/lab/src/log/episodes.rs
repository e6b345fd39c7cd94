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
    /// Episodes left out: observations of them were lost, or they are a single observation.
    pub left_out: u64,
    /// Where the log is damaged; all before it was used.
    pub log_damage: Option<String>,
}

/// An episode of a log, as far as it has come.
pub struct LoggedEpisode {
    builder: EpisodeBuilder,
    task: &'static str,
    next_step: u32,
    broken: bool,
}

/// Writes every episode of a log of which no observation was lost, one folder a task.
///
/// # Errors
/// [`LogError::Io`] or [`LogError::Episode`].
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
        Self { builder: EpisodeBuilder::new(), task, next_step: observation.step, broken: false }
    }

    /// Adds an observation; after a `gap`, or another step than the next, the episode is broken.
    pub fn add(&mut self, observation: &Observation<'_>, gap: bool) {
        // A transition over a gap would teach the trainer a dynamics that does not exist.
        self.broken |= gap || observation.step != self.next_step;
        self.next_step = observation.step.wrapping_add(1);
        if !self.broken {
            self.broken = self.builder.push(observation).is_err();
        }
    }

    /// The episode, if no observation of it was lost.
    #[must_use]
    pub fn finish(mut self) -> Option<Episode> {
        self.builder.finish().filter(|_| !self.broken)
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
    let Some(episode) = running.finish().filter(|episode| episode.len() > 1) else {
        written.left_out += 1;
        return Ok(());
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
