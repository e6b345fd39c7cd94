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

use rcwm_models::bundle::{BundleKind, Manifest, PartName};
use rcwm_models::files::FileError;
use rcwm_models::interface::Camera;
use rcwm_models::lock::{Lock, LockError};
use rcwm_models::wire::{Observation, ObservationFlags};
use rcwm_runtime::controller::EpisodeResult;
use rcwm_runtime::engine::{self, EngineError, Input, Output, Part};
use rcwm_runtime::log::{Entry, LogError, LogReader, LoggedTick};
use serde::Serialize;

use crate::log::{LoggedEpisode, ReplayError, Replayer};
use panels::{Decoded, Frame, Shown, View, film_frame};
use rcwm_models::picture::PictureError;

/// Longest film, in ticks and in bytes of its frames; longer episodes are filmed to here and kept whole as `.npz`.
const FILM_TICKS_MAX: usize = 1000;
const FILM_BYTES_MAX: usize = 512 << 20;

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
    /// The robot shows nothing.
    #[error(
        "film: the robot {robot} has no camera, there is nothing to film; `rcwm-lab replay` and `rcwm-lab telemetry` use such a log"
    )]
    NoCamera {
        /// Its interface's name.
        robot: String,
    },
    /// What the policy sees is not what the robot shows.
    #[error(
        "film: camera {camera} of the robot {robot} is {found}, the policy sees {expected}; name the bundle that was made for this \
         robot, or leave --bundle out to film what was seen"
    )]
    Camera { robot: String, camera: String, found: String, expected: String },
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
    /// Episodes not written: observations of them were lost, or they are none that could be read again.
    pub broken_episodes: u64,
    /// Why the first of them was not.
    pub broken_because: Option<String>,
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
    /// With room for its outputs.
    decoder: Option<(Box<dyn Part>, Decoded)>,
    filmed: Filmed,
    /// Number of the next episode.
    number: u64,
    /// Episodes that may still begin; none when all that are wanted are over.
    episodes_left: Option<u64>,
    running: Option<Running>,
}

/// The episode being filmed.
struct Running {
    film: Vec<Frame>,
    film_bytes: usize,
    rate_hz: f64,
    episode: LoggedEpisode,
    result: EpisodeResult,
}

impl<'a> Filming<'a> {
    fn new(folder: &'a Path, replayer: Option<Replayer>, episodes_max: u64) -> Result<Self, FilmError> {
        let mut this = Self {
            folder,
            replayer,
            decoder: None,
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
        self.decoder = None;
        // What is drawn is what two branches see.
        let draws = bundle.manifest.kind == BundleKind::Rcwm && bundle.part(PartName::Decoder).is_some();
        if let (Some(model), true) = (&bundle.manifest.model, draws) {
            let decoder = engine::load(bundle, PartName::Decoder, replayer.engine())?;
            self.decoder = Some((decoder, Decoded::of(model)));
        }
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
        let views = self.views(observation)?;
        self.decode()?;
        let format = observation.format();
        let running = self.running.get_or_insert_with(|| Running::start(observation));
        running.rate_hz = match observation.period_ns {
            0 => format.interface().rate_hz,
            period_ns => 1e9 / period_ns as f64,
        };
        running.result.add(observation);
        let mut action = format.zeros();
        // Of what is no number, or was not sent, no bar is drawn.
        let _ = format.normaliser().from_units(&tick.record.answer.action, &mut action);
        let shown = Shown {
            views: &views,
            decoded: self.decoder.as_ref().map(|(_, decoded)| decoded),
            action: &action,
            source: tick.record.answer.source,
            step: observation.step,
            return_sum: running.result.return_sum,
            success: running.result.success,
        };
        if running.film.len() < FILM_TICKS_MAX && running.film_bytes < FILM_BYTES_MAX {
            let frame = film_frame(&shown);
            running.film_bytes += frame.canvas.rgb.len();
            running.film.push(frame);
        }
        running.episode.add(observation, tick.record.dropped_before > 0 && !tick.record.is_first);
        if observation.is(ObservationFlags::LAST) { self.finish() } else { Ok(()) }
    }

    /// What is shown of an observation: the cameras that the policy reads, in its order; without a policy all of the robot.
    fn views<'o>(&self, observation: &Observation<'o>) -> Result<Vec<View<'o>>, FilmError> {
        let robot = observation.format().interface();
        let view = |at: usize| {
            let Camera { name, shape: [rows, columns, _], .. } = &robot.camera[at];
            View { name, size: [*rows, *columns], image: observation.image(at) }
        };
        let Some(replayer) = &self.replayer else {
            if robot.camera.is_empty() {
                return Err(FilmError::NoCamera { robot: robot.name.clone() });
            }
            return Ok((0..robot.camera.len()).map(view).collect());
        };
        let Manifest { interface, policy, .. } = &replayer.bundle().manifest;
        let named = |name: &String| interface.camera.iter().find(|camera| camera.name == *name);
        let found = |needed: &Camera| {
            let at = robot.camera.iter().position(|camera| camera.name == needed.name);
            match at.filter(|at| robot.camera[*at].shape == needed.shape) {
                Some(at) => Ok(view(at)),
                None => Err(FilmError::Camera {
                    robot: robot.name.clone(),
                    camera: needed.name.clone(),
                    found: at.map_or_else(|| "missing".to_owned(), |at| robot.camera[at].size()),
                    expected: needed.size(),
                }),
            }
        };
        policy.inputs.iter().filter_map(named).map(found).collect()
    }

    fn decode(&mut self) -> Result<(), FilmError> {
        let (Some((decoder, decoded)), Some(replayer)) = (&mut self.decoder, &self.replayer) else {
            return Ok(());
        };
        let [robot, environment] = replayer.policy().state().branches.as_slice() else { return Ok(()) };
        let inputs = [
            Input::I64(&robot.z),
            Input::F32(&robot.h),
            Input::I64(&environment.z),
            Input::F32(&environment.h),
        ];
        Ok(decoder.run(&inputs, &mut decoded.outputs().map(Output::F32))?)
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
            Ok(episode) => {
                episode.write(&path("npz"))?;
                self.filmed.episodes.push(path("npz"));
            }
            Err(refused) => {
                self.filmed.broken_episodes += 1;
                self.filmed.broken_because.get_or_insert(refused.to_string());
            }
        }
        let Some(first) = running.film.first() else { return Ok(()) };
        let frames: Vec<_> = running.film.iter().map(|frame| &frame.canvas).collect();
        gif::write_film(&path("gif"), &frames, running.rate_hz, first.film_scale())?;
        let chosen = gif::strip_choice(frames.len());
        let columns: Vec<_> = chosen.into_iter().map(|index| running.film[index].strip()).collect();
        gif::write_strip(&path("png"), &columns, first.strip_scale())?;
        self.filmed.films.push(path("gif"));
        Ok(())
    }
}

impl Running {
    fn start(observation: &Observation<'_>) -> Self {
        Self {
            film: Vec::new(),
            film_bytes: 0,
            rate_hz: observation.format().interface().rate_hz,
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
