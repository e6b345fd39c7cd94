//! Films, strips and episodes of a logged run: what the policy saw, and with a decoder what it made of it, branch by branch.
//!
//! The run is replayed, so that the states are those the policy had, bit for bit.
//!
//! | file | holds |
//! | --- | --- |
//! | `episode-0003.gif` | what the policy saw; with a decoder also what it made of it |
//! | `episode-0003.png` | ten moments of it side by side |
//! | `episode-0003.npz` | the episode in Dreamer's form, if no observation of it was lost |
//!
//! A folder that holds episodes already is gone on with: numbers follow the largest there.

mod canvas;
mod gif;
mod panels;

use std::path::{Path, PathBuf};

use rcwm_models::IMAGE_BYTES;
use rcwm_models::bundle::{BundleKind, PartName};
use rcwm_models::files::FileError;
use rcwm_models::lock::{Lock, LockError};
use rcwm_models::wire::{Observation, ObservationFlags};
use rcwm_runtime::controller::EpisodeResult;
use rcwm_runtime::engine::{self, EngineError, Input, Output, Part};
use rcwm_runtime::log::{Entry, LogError, LogReader, LoggedTick};
use serde::Serialize;

use crate::log::{LoggedEpisode, ReplayError, Replayer};
use canvas::Canvas;
use panels::{Decoded, Shown, film_frame, strip_panels};
use rcwm_models::picture::PictureError;

/// Longest film, in ticks; longer episodes are filmed to here and kept whole as `.npz`.
const FILM_TICKS_MAX: usize = 1000;
/// Pace of a film of a run in lock-step without a bundle, in Hz: Meta-World's.
const RATE_HZ: f64 = 40.0;

/// Why nothing could be filmed.
#[derive(Debug, thiserror::Error)]
pub enum FilmError {
    /// The log could not be read or replayed.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// A file could not be written.
    #[error("film: {0}")]
    File(#[from] FileError),
    /// An episode could not be written.
    #[error("film: {0}")]
    Episode(#[from] rcwm_models::episode::EpisodeError),
    /// Pictures of another size.
    #[error("film: pictures of {found} bytes; films are drawn of 64 x 64 x 3 ({expected} bytes)")]
    Size { found: usize, expected: usize },
    /// Somebody else writes into the folder.
    #[error("film: {0}")]
    Lock(#[from] LockError),
    /// The decoder failed.
    #[error("film: {0}")]
    Engine(#[from] EngineError),
    /// A strip could not be written.
    #[error("film: {0}")]
    Strip(#[from] PictureError),
    /// A film could not be packed.
    #[error("film: {path}: {reason}")]
    Picture { path: PathBuf, reason: String },
}

impl From<LogError> for FilmError {
    fn from(error: LogError) -> Self {
        Self::Replay(error.into())
    }
}

/// What was filmed.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Filmed {
    /// Films written; the strips lie beside them.
    pub films: Vec<PathBuf>,
    /// Episodes written.
    pub episodes: Vec<PathBuf>,
    /// Episodes not written because observations of them were lost.
    pub broken_episodes: u64,
    /// Where the log is damaged; all before it was filmed.
    pub log_damage: Option<String>,
}

/// Films the first `episodes_max` episodes of a log into a folder, which is made where it is missing. Without `replayer` only what was
/// seen is shown. `go_on` is asked after every entry with the bytes read and in all.
pub fn film(
    log: &mut LogReader,
    replayer: Option<Replayer>,
    folder: &Path,
    episodes_max: u64,
    go_on: &mut dyn FnMut((u64, u64)) -> bool,
) -> Result<Filmed, FilmError> {
    std::fs::create_dir_all(folder).map_err(|source| FileError::Io { path: folder.to_path_buf(), source })?;
    let _lock = Lock::take(folder)?;
    let mut filming = Filming::new(folder, replayer, episodes_max)?;
    loop {
        match log.read() {
            Ok(Some(entry)) => filming.entry(&entry)?,
            Ok(None) => break,
            Err(error @ LogError::Damaged { .. }) => {
                filming.filmed.log_damage = Some(error.to_string());
                break;
            }
            Err(error) => return Err(error.into()),
        }
        if filming.episodes_left.is_none() || !go_on(log.progress_bytes()) {
            break;
        }
    }
    filming.finish()?;
    Ok(filming.filmed)
}

struct Filming<'a> {
    folder: &'a Path,
    replayer: Option<Replayer>,
    decoder: Option<Box<dyn Part>>,
    decoded: Decoded,
    /// Films play at the rate of the policy unless the robot says its own.
    rate_hz: f64,
    filmed: Filmed,
    /// Number of the next episode.
    number: u64,
    /// Episodes that may still begin; none when all that are wanted are over.
    episodes_left: Option<u64>,
    running: Option<Running>,
}

/// The episode being filmed.
struct Running {
    film: Vec<Canvas>,
    panels: Vec<Vec<Canvas>>,
    episode: LoggedEpisode,
    result: EpisodeResult,
}

impl<'a> Filming<'a> {
    fn new(folder: &'a Path, replayer: Option<Replayer>, episodes_max: u64) -> Result<Self, FilmError> {
        let mut this = Self {
            folder,
            replayer,
            decoder: None,
            decoded: Decoded::new(),
            rate_hz: RATE_HZ,
            filmed: Filmed::default(),
            number: next_number(folder),
            episodes_left: Some(episodes_max),
            running: None,
        };
        this.load_decoder()?;
        Ok(this)
    }

    /// The decoder of the policy that runs.
    fn load_decoder(&mut self) -> Result<(), FilmError> {
        let Some(replayer) = &self.replayer else { return Ok(()) };
        let bundle = replayer.bundle();
        self.rate_hz = bundle.manifest.interface.rate_hz;
        // What is drawn is what two branches see.
        let part = bundle.part(PartName::Decoder).filter(|_| bundle.manifest.kind == BundleKind::Rcwm);
        self.decoder =
            part.map(|_| engine::load(bundle, PartName::Decoder, replayer.engine())).transpose()?;
        Ok(())
    }

    fn entry(&mut self, entry: &Entry) -> Result<(), FilmError> {
        if let Some(replayer) = &mut self.replayer {
            replayer.entry(entry)?;
        }
        match entry {
            Entry::Policy(_) => self.load_decoder(),
            Entry::Tick(tick) => match &tick.observation {
                Some(observation) => self.tick(tick, &observation.view()),
                // A tick without an observation has nothing to show.
                None => Ok(()),
            },
        }
    }

    fn tick(&mut self, tick: &LoggedTick, observation: &Observation<'_>) -> Result<(), FilmError> {
        if tick.record.is_first {
            self.finish()?;
            self.episodes_left = self.episodes_left.and_then(|left| left.checked_sub(1));
        }
        if self.episodes_left.is_none() {
            return Ok(());
        }
        self.decode()?;
        if observation.period_ns > 0 {
            self.rate_hz = 1e9 / observation.period_ns as f64;
        }
        let running = self.running.get_or_insert_with(|| Running::start(observation));
        running.result.add(observation);
        let image = observation.image(0);
        if image.len() != IMAGE_BYTES {
            return Err(FilmError::Size { found: image.len(), expected: IMAGE_BYTES });
        }
        let shown = Shown {
            image,
            decoded: self.decoder.is_some().then_some(&self.decoded),
            action: tick.record.answer.action,
            source: tick.record.answer.source,
            step: observation.step,
            return_sum: running.result.return_sum,
            success: running.result.success,
        };
        if running.film.len() < FILM_TICKS_MAX {
            running.film.push(film_frame(&shown));
            running.panels.push(strip_panels(&shown));
        }
        running.episode.add(observation, tick.record.dropped_before > 0 && !tick.record.is_first);
        if observation.is(ObservationFlags::LAST) { self.finish() } else { Ok(()) }
    }

    fn decode(&mut self) -> Result<(), FilmError> {
        let (Some(decoder), Some(replayer)) = (&mut self.decoder, &self.replayer) else { return Ok(()) };
        let [robot, environment] = replayer.policy().state().branches.as_slice() else { return Ok(()) };
        let inputs = [
            Input::I64(&robot.z),
            Input::F32(&robot.h),
            Input::I64(&environment.z),
            Input::F32(&environment.h),
        ];
        let Decoded { image, robot_image, robot_mask, environment_image, environment_mask } =
            &mut self.decoded;
        let outputs = [image, robot_image, robot_mask, environment_image, environment_mask];
        Ok(decoder.run(&inputs, &mut outputs.map(|values| Output::F32(values)))?)
    }

    /// Writes the episode that is over.
    fn finish(&mut self) -> Result<(), FilmError> {
        let Some(running) = self.running.take() else { return Ok(()) };
        // Numbered in the order of the log: a simulator that was started again counts from 0 again.
        let number = self.number;
        self.number += 1;
        let path = |ending: &str| self.folder.join(format!("episode-{number:04}.{ending}"));
        // The data before the pictures: on a full disk it is what must not be lost.
        match running.episode.finish() {
            Some(episode) => {
                episode.write(&path("npz"))?;
                self.filmed.episodes.push(path("npz"));
            }
            None => self.filmed.broken_episodes += 1,
        }
        gif::write_film(&path("gif"), &running.film, self.rate_hz)?;
        let chosen = gif::strip_choice(running.panels.len());
        let columns: Vec<_> = chosen.into_iter().map(|index| running.panels[index].as_slice()).collect();
        gif::write_strip(&path("png"), &columns)?;
        self.filmed.films.push(path("gif"));
        Ok(())
    }
}

impl Running {
    fn start(observation: &Observation<'_>) -> Self {
        Self {
            film: Vec::new(),
            panels: Vec::new(),
            episode: LoggedEpisode::start(observation),
            result: EpisodeResult::start(observation),
        }
    }
}

/// Behind all episodes that the folder holds, whatever there is of each.
fn next_number(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let number = |name: &str| name.strip_prefix("episode-")?.split('.').next()?.parse::<u64>().ok();
    entries.filter_map(|entry| number(&entry.file_name().to_string_lossy())).max().map_or(0, |last| last + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_follow_the_largest_there() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(next_number(folder.path()), 0);
        for name in ["episode-0004.gif", "episode-0011.npz", "episode-x.gif", "run.rcwmlog"] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        assert_eq!(next_number(folder.path()), 12);
    }
}
