//! Films, strips and episodes of what the policy saw.
//!
//! The loop only copies a tick into a bounded queue after its action was sent; decoding, drawing and writing happen in another
//! thread. In lock-step a full queue makes the loop wait, in real time the tick is dropped and counted.
//!
//! A folder that holds episodes already is gone on with: numbers follow the largest there.
//!
//! | file | holds |
//! | --- | --- |
//! | `episode-0003.gif` | what the policy saw; with a decoder also what it made of it, branch by branch |
//! | `episode-0003.png` | ten moments of it side by side |
//! | `episode-0003.npz` | the episode in Dreamer's form, if no observation of it was lost |

mod canvas;
mod film;
mod panels;
mod worker;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::episode::EpisodeError;
use rcwm_models::files::FileError;
use rcwm_models::lock::{Lock, LockError};
use rcwm_models::wire::{Action, Observation};

use crate::controller::{Tick, TickObserver};
use crate::engine::{self, EngineError, EngineSettings};
use crate::policy::State;
use worker::Worker;

/// Ticks that may wait for the recorder: a few episodes, about 20 MB.
const QUEUE_TICKS: usize = 1024;

/// Why something could not be recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The folder could not be made, or a file not written.
    #[error("recording: {0}")]
    File(#[from] FileError),
    /// Another run records there.
    #[error("recording: {0}")]
    Lock(#[from] LockError),
    /// The folder could not be made.
    #[error("recording: {path}: {source}")]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// The film could not be written.
    #[error("recording: {path}: {reason}")]
    Film {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A picture is wider than its format allows.
    #[error("recording: a picture of {pixels} pixels is too wide for a film")]
    TooWide {
        /// Its side before enlarging.
        pixels: usize,
    },
    /// The strip could not be written.
    #[error("recording: {path}: {reason}")]
    Strip {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The episode could not be written.
    #[error("recording: {0}")]
    Episode(#[from] EpisodeError),
    /// The decoder failed.
    #[error("recording: {0}")]
    Engine(#[from] EngineError),
    /// The thread could not be started, or has panicked.
    #[error("recording: {0}")]
    Thread(String),
}

/// A tick on its way to the recorder.
struct Frame {
    observation: Observation,
    state: State,
    answer: Action,
    is_first: bool,
    return_sum: f64,
    success: bool,
}

/// What was recorded.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Recorded {
    /// Films written.
    pub films: Vec<PathBuf>,
    /// Episodes written.
    pub episodes: Vec<PathBuf>,
    /// Episodes not written because observations of them were lost.
    pub broken_episodes: u64,
}

/// The loop's end of a recorder.
pub struct Recorder {
    queue: Option<SyncSender<Box<Frame>>>,
    thread: Option<JoinHandle<Result<Recorded, RecordError>>>,
    /// Nobody else records there.
    _lock: Lock,
    dropped: Arc<AtomicU64>,
    episodes_left: u64,
}

impl Recorder {
    /// Starts recording the first `episodes_max` episodes into a folder, which is made where it is missing.
    pub fn start(
        folder: &Path,
        episodes_max: u64,
        bundle: &Bundle,
        engine: EngineSettings,
    ) -> Result<Self, RecordError> {
        std::fs::create_dir_all(folder)
            .map_err(|source| RecordError::Folder { path: folder.to_path_buf(), source })?;
        let lock = Lock::take(folder)?;
        let decoder = match bundle.part(PartName::Decoder) {
            Some(_) => Some(engine::load(bundle, PartName::Decoder, engine)?),
            None => None,
        };
        let worker = Worker::new(folder, decoder, bundle.manifest.control.rate_hz);
        let (queue, frames) = sync_channel(QUEUE_TICKS);
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || worker.run(&frames))
            .map_err(|error| RecordError::Thread(error.to_string()))?;
        Ok(Self {
            queue: Some(queue),
            thread: Some(thread),
            _lock: lock,
            dropped: Arc::default(),
            episodes_left: episodes_max,
        })
    }

    /// Ticks dropped so far.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Waits until everything is written.
    ///
    /// # Errors
    /// The first error of the recording thread.
    pub fn finish(mut self) -> Result<Recorded, RecordError> {
        self.queue = None;
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) => Err(RecordError::Thread("the recording thread panicked".into())),
            None => Ok(Recorded::default()),
        }
    }

    fn send(&mut self, frame: Box<Frame>) {
        let Some(queue) = &self.queue else { return };
        let lockstep = frame.observation.period_ns == 0;
        let sent = if lockstep {
            queue.send(frame).map_err(|_| true)
        } else {
            queue.try_send(frame).map_err(|error| matches!(error, TrySendError::Disconnected(_)))
        };
        match sent {
            Ok(()) => {}
            // The thread has ended with an error, which `finish` will report.
            Err(true) => self.queue = None,
            Err(false) => {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

impl TickObserver for Recorder {
    fn ticked(&mut self, tick: &Tick<'_>) {
        // A tick without an observation has nothing to show.
        let Some(observation) = tick.observation else { return };
        if tick.is_first {
            if self.episodes_left == 0 {
                self.queue = None;
            }
            self.episodes_left = self.episodes_left.saturating_sub(1);
        }
        if self.queue.is_none() {
            return;
        }
        self.send(Box::new(Frame {
            observation: *observation,
            state: tick.policy.state().clone(),
            answer: tick.answer,
            is_first: tick.is_first,
            return_sum: tick.running.return_sum,
            success: tick.running.success,
        }));
    }
}
