//! A JSON line every so often while a run goes on: a sink of the loop's records.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::controller::Counters;
use crate::policy::{CallOutcome, Surprise};
use crate::record::{Record, Sink};
use crate::telemetry::{Latency, Telemetry};

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
    Io { path: PathBuf, source: std::io::Error },
    /// Another run appends to the file.
    #[error("telemetry {path} is in use: another run appends to it; name another file")]
    InUse { path: PathBuf },
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
    dynamics: Histogram<u64>,
}

#[derive(Serialize)]
struct Summary {
    seconds: f64,
    ticks: u64,
    rate_hz: f64,
    latency: Vec<Latency>,
    #[serde(skip_serializing_if = "Option::is_none")]
    robot_surprise: Option<SurpriseStatistics>,
    #[serde(skip_serializing_if = "Option::is_none")]
    environment_surprise: Option<SurpriseStatistics>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dynamics_surprise: Option<SurpriseStatistics>,
}

#[derive(Serialize)]
struct SnapshotLine<'a> {
    time_unix_s: f64,
    /// The last line of a run.
    last: bool,
    interval: Summary,
    total: Summary,
    counters: &'a Counters,
    /// Ticks without a record, because the writer was too late for them: their surprise is missing in the statistics.
    samples_dropped: u64,
}

impl Gathered {
    fn new() -> Self {
        let empty =
            Histogram::new_with_bounds(1, MILLINATS_MAX, 3).expect("the bounds are constants that fit");
        Self {
            ticks: 0,
            telemetry: Telemetry::new(),
            robot: empty.clone(),
            environment: empty.clone(),
            dynamics: empty,
        }
    }

    fn add(&mut self, record: &Record) {
        self.ticks += 1;
        for (stage, time_ns) in &record.recordings {
            self.telemetry.record(*stage, *time_ns);
        }
        let mut surprises = record.calls.iter().filter_map(|call| match call.outcome {
            CallOutcome::Decided { surprise, .. } => surprise,
            _ => None,
        });
        // Rounding may put a divergence of 0 a little below it.
        let record = |to: &mut Histogram<u64>, nats: f32| to.saturating_record((nats.max(0.0) * 1e3) as u64);
        match surprises.next_back() {
            Some(Surprise::Rcwm { robot, environment }) => {
                record(&mut self.robot, robot);
                record(&mut self.environment, environment);
            }
            Some(Surprise::Dreamer(dynamics)) => record(&mut self.dynamics, dynamics),
            None => {}
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
            dynamics_surprise: statistics(&self.dynamics),
        }
    }
}

fn statistics(millinats: &Histogram<u64>) -> Option<SurpriseStatistics> {
    let at = |quantile: f64| millinats.value_at_quantile(quantile) as f64 / 1e3;
    let (mean, max) = (millinats.mean() / 1e3, millinats.max() as f64 / 1e3);
    (!millinats.is_empty()).then(|| SurpriseStatistics { mean, p50: at(0.5), p99: at(0.99), max })
}

/// Writes the lines.
pub struct Snapshots {
    settings: SnapshotSettings,
    file: File,
    start: Instant,
    interval_start: Instant,
    interval: Gathered,
    total: Gathered,
    counters: Counters,
    failed: Option<SnapshotError>,
}

impl Snapshots {
    /// Opens the file.
    ///
    /// # Errors
    /// See [`SnapshotError`].
    pub fn start(settings: SnapshotSettings) -> Result<Self, SnapshotError> {
        let io = |source| SnapshotError::Io { path: settings.file.clone(), source };
        let file = OpenOptions::new().create(true).append(true).open(&settings.file).map_err(io)?;
        // Held as long as the file is open. Not every kind of file can be locked.
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            return Err(SnapshotError::InUse { path: settings.file });
        }
        let now = Instant::now();
        Ok(Self {
            settings,
            file,
            start: now,
            interval_start: now,
            interval: Gathered::new(),
            total: Gathered::new(),
            counters: Counters::default(),
            failed: None,
        })
    }

    /// Writes the last line.
    ///
    /// # Errors
    /// The first error there was.
    pub fn finish(mut self, dropped: u64) -> Result<(), SnapshotError> {
        match self.failed.take() {
            Some(failed) => Err(failed),
            None => self.write(true, dropped),
        }
    }

    fn write(&mut self, last: bool, dropped: u64) -> Result<(), SnapshotError> {
        let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let line = SnapshotLine {
            time_unix_s: since_1970.map_or(0.0, |time| time.as_secs_f64()),
            last,
            interval: self.interval.summary(self.interval_start.elapsed().as_secs_f64()),
            total: self.total.summary(self.start.elapsed().as_secs_f64()),
            counters: &self.counters,
            samples_dropped: dropped,
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

impl Sink for Snapshots {
    fn wants_pictures(&self) -> bool {
        false
    }

    fn take(&mut self, record: &Record) {
        self.interval.add(record);
        self.total.add(record);
        self.counters = record.counters;
    }

    fn pause(&mut self, dropped: u64) {
        if self.failed.is_none() && self.interval_start.elapsed() >= self.settings.every {
            self.failed = self.write(false, dropped).err();
        }
    }
}
