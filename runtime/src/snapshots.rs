//! A JSON line every so often while a run goes on.
//!
//! The loop copies what was recorded since the last tick into a bounded queue; histograms and the file belong to another thread. What
//! finds the queue full is counted, and each line says how much it was.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::controller::{Counters, Tick, TickObserver};
use crate::policy::{CallOutcome, Policy, Surprise};
use crate::telemetry::{Latency, Stage, Telemetry};

/// Ticks that may wait to be taken up: one second at 4 kHz.
const QUEUE_TICKS: usize = 4096;
/// Recordings that are passed on at once; a tick that has more is passed on in pieces.
const RECORDINGS_MAX: usize = 24;
/// How often the queue is looked at. The thread sleeps in between instead of waiting on the queue, so that the loop need not wake it.
const LOOK: Duration = Duration::from_millis(50);
/// Surprise is counted in thousandths of a nat, up to a million nats.
const MILLINATS_MAX: u64 = 1_000_000_000;

/// Where the lines go, and how often.
#[derive(Debug, Clone)]
pub struct SnapshotSettings {
    /// The file; lines are appended.
    pub file: PathBuf,
    /// Time between two lines.
    pub every: Duration,
}

/// Why there are no snapshots.
#[derive(Debug, thiserror::Error)]
pub enum SnapshotError {
    /// The file could not be opened or written.
    #[error("telemetry {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Another run appends to the file.
    #[error("telemetry {path} is in use: another run appends to it; name another file")]
    InUse {
        /// The file.
        path: PathBuf,
    },
    /// The thread could not be started, or has panicked.
    #[error("telemetry: {0}")]
    Thread(String),
}

/// What a tick adds, or a piece of it.
struct Sample {
    /// It is the last piece of its tick.
    whole: bool,
    recordings: [(Stage, u64); RECORDINGS_MAX],
    count: usize,
    surprise: Option<Surprise>,
    counters: Counters,
}

/// The loop's end of the snapshots.
pub struct Snapshots {
    queue: Option<SyncSender<Sample>>,
    thread: Option<JoinHandle<Result<(), SnapshotError>>>,
    dropped: Arc<AtomicU64>,
    recordings_seen: u64,
    policy: u64,
    calls_seen: u64,
}

impl Snapshots {
    /// Starts writing.
    pub fn start(settings: SnapshotSettings) -> Result<Self, SnapshotError> {
        let io = |source| SnapshotError::Io { path: settings.file.clone(), source };
        let file = OpenOptions::new().create(true).append(true).open(&settings.file).map_err(io)?;
        // Held as long as the file is open. Not every kind of file can be locked.
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            return Err(SnapshotError::InUse { path: settings.file });
        }
        let (queue, samples) = sync_channel(QUEUE_TICKS);
        let dropped = Arc::new(AtomicU64::new(0));
        let writer = Writer::new(settings, file, Arc::clone(&dropped));
        let thread = std::thread::Builder::new()
            .name("telemetry".into())
            .spawn(move || writer.run(&samples))
            .map_err(|error| SnapshotError::Thread(error.to_string()))?;
        let (queue, thread) = (Some(queue), Some(thread));
        Ok(Self { queue, thread, dropped, recordings_seen: 0, policy: u64::MAX, calls_seen: 0 })
    }

    /// Writes the last line and ends.
    ///
    /// # Errors
    /// The first error of the thread.
    pub fn finish(mut self) -> Result<(), SnapshotError> {
        self.queue = None;
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) => Err(SnapshotError::Thread("the thread panicked".into())),
            None => Ok(()),
        }
    }

    /// What was decided since the last tick.
    fn surprise(&mut self, policy: &Policy) -> Option<Surprise> {
        if policy.number() != self.policy {
            (self.policy, self.calls_seen) = (policy.number(), 0);
        }
        let surprises = policy.calls_since(self.calls_seen).filter_map(|call| match call.outcome {
            CallOutcome::Decided { surprise, .. } => surprise,
            _ => None,
        });
        let surprise = surprises.last();
        self.calls_seen = policy.calls_made();
        surprise
    }

    fn send(&self, sample: Sample) {
        // Nobody hears it only when the thread has ended with an error, which `finish` will report.
        if let Some(queue) = &self.queue
            && queue.try_send(sample).is_err()
        {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl TickObserver for Snapshots {
    fn ticked(&mut self, tick: &Tick<'_>) {
        let counters = *tick.counters;
        let piece = || Sample {
            whole: false,
            recordings: [(Stage::Tick, 0); RECORDINGS_MAX],
            count: 0,
            surprise: None,
            counters,
        };
        let mut sample = piece();
        for recording in tick.telemetry.recorded_since(self.recordings_seen) {
            if sample.count == RECORDINGS_MAX {
                self.send(std::mem::replace(&mut sample, piece()));
            }
            sample.recordings[sample.count] = recording;
            sample.count += 1;
        }
        self.recordings_seen = tick.telemetry.recorded();
        (sample.whole, sample.surprise) = (true, self.surprise(tick.policy));
        self.send(sample);
    }
}

/// Statistics of one branch's surprise, in nats.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct SurpriseStatistics {
    mean: f64,
    p50: f64,
    p99: f64,
    max: f64,
}

/// What is gathered over an interval, or over the whole run.
struct Gathered {
    ticks: u64,
    telemetry: Telemetry,
    robot: Histogram<u64>,
    environment: Histogram<u64>,
}

#[derive(Serialize)]
struct Summary {
    seconds: f64,
    ticks: u64,
    rate_hz: f64,
    latency: Vec<Latency>,
    robot_surprise: Option<SurpriseStatistics>,
    environment_surprise: Option<SurpriseStatistics>,
}

#[derive(Serialize)]
struct SnapshotLine<'a> {
    time_unix_s: f64,
    /// The last line of a run.
    last: bool,
    interval: Summary,
    total: Summary,
    counters: &'a Counters,
    /// Ticks, or pieces of one, that are missing in the statistics because the queue was full.
    samples_dropped: u64,
}

impl Gathered {
    fn new() -> Self {
        let empty =
            Histogram::new_with_bounds(1, MILLINATS_MAX, 3).expect("the bounds are constants that fit");
        Self { ticks: 0, telemetry: Telemetry::new(), robot: empty.clone(), environment: empty }
    }

    fn add(&mut self, sample: &Sample) {
        self.ticks += u64::from(sample.whole);
        for (stage, time_ns) in &sample.recordings[..sample.count] {
            self.telemetry.record(*stage, *time_ns);
        }
        if let Some(Surprise { robot, environment }) = sample.surprise {
            // Rounding may put a divergence of 0 a little below it.
            self.robot.saturating_record((robot.max(0.0) * 1e3) as u64);
            self.environment.saturating_record((environment.max(0.0) * 1e3) as u64);
        }
    }

    fn summary(&self, seconds: f64) -> Summary {
        Summary {
            seconds,
            ticks: self.ticks,
            rate_hz: self.ticks as f64 / seconds.max(1e-9),
            latency: self.telemetry.latencies(),
            robot_surprise: statistics(&self.robot),
            environment_surprise: statistics(&self.environment),
        }
    }
}

fn statistics(millinats: &Histogram<u64>) -> Option<SurpriseStatistics> {
    let at = |quantile: f64| millinats.value_at_quantile(quantile) as f64 / 1e3;
    let (mean, max) = (millinats.mean() / 1e3, millinats.max() as f64 / 1e3);
    (!millinats.is_empty()).then(|| SurpriseStatistics { mean, p50: at(0.5), p99: at(0.99), max })
}

struct Writer {
    settings: SnapshotSettings,
    file: File,
    dropped: Arc<AtomicU64>,
    start: Instant,
    interval_start: Instant,
    interval: Gathered,
    total: Gathered,
    counters: Counters,
}

impl Writer {
    fn new(settings: SnapshotSettings, file: File, dropped: Arc<AtomicU64>) -> Self {
        let now = Instant::now();
        let (interval, total) = (Gathered::new(), Gathered::new());
        let counters = Counters::default();
        Self { settings, file, dropped, start: now, interval_start: now, interval, total, counters }
    }

    fn run(mut self, samples: &Receiver<Sample>) -> Result<(), SnapshotError> {
        loop {
            let over = self.gather(samples);
            if over || self.interval_start.elapsed() >= self.settings.every {
                self.write(over)?;
            }
            if over {
                return Ok(());
            }
            std::thread::sleep(LOOK.min(self.settings.every));
        }
    }

    /// Takes up what waits; true when nothing more will come.
    fn gather(&mut self, samples: &Receiver<Sample>) -> bool {
        loop {
            match samples.try_recv() {
                Ok(sample) => {
                    self.interval.add(&sample);
                    self.total.add(&sample);
                    self.counters = sample.counters;
                }
                Err(TryRecvError::Empty) => return false,
                Err(TryRecvError::Disconnected) => return true,
            }
        }
    }

    fn write(&mut self, last: bool) -> Result<(), SnapshotError> {
        let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let line = SnapshotLine {
            time_unix_s: since_1970.map_or(0.0, |time| time.as_secs_f64()),
            last,
            interval: self.interval.summary(self.interval_start.elapsed().as_secs_f64()),
            total: self.total.summary(self.start.elapsed().as_secs_f64()),
            counters: &self.counters,
            samples_dropped: self.dropped.load(Ordering::Relaxed),
        };
        let io = |source| SnapshotError::Io { path: self.settings.file.clone(), source };
        let mut bytes = serde_json::to_vec(&line).map_err(|error| io(error.into()))?;
        bytes.push(b'\n');
        self.file.write_all(&bytes).map_err(io)?;
        self.interval = Gathered::new();
        self.interval_start = Instant::now();
        Ok(())
    }
}
