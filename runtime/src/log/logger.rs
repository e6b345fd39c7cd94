//! The loop's end of a log.

use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use super::LogError;
use super::record::{BundleIdentity, Header, Machine};
use super::slot::Slot;
use super::worker::{LogSummary, Worker};
use crate::controller::{Fallback, Tick, TickObserver};
use crate::engine::EngineSettings;
use crate::policy::{Policy, STAGES, Sampling};

/// What a log says about its run.
#[derive(Debug, Clone)]
pub struct LogSettings {
    /// The link's instance.
    pub instance: String,
    /// The engine.
    pub engine: EngineSettings,
    /// How latents and actions are chosen.
    pub sampling: Sampling,
    /// What is sent where the policy has nothing fit to send.
    pub fallback: Fallback,
    /// Largest change of an action's component from one action to the next.
    pub rate_max: Option<f32>,
    /// Ticks that may wait for the writer.
    pub pool_ticks: usize,
}

impl LogSettings {
    /// Ticks that may wait for the writer unless told otherwise: half a second at 1 kHz, about 13 MB.
    pub const POOL_TICKS: usize = 512;

    /// Of a controller that holds the last action and limits no rate.
    #[must_use]
    pub fn new(instance: &str, engine: EngineSettings, sampling: Sampling) -> Self {
        let (fallback, rate_max) = (Fallback::Hold, None);
        Self {
            instance: instance.to_owned(),
            engine,
            sampling,
            fallback,
            rate_max,
            pool_ticks: Self::POOL_TICKS,
        }
    }
}

/// Logs every tick that it is shown.
pub struct Logger {
    file: PathBuf,
    full: Option<SyncSender<Box<Slot>>>,
    free: Receiver<Box<Slot>>,
    thread: Option<JoinHandle<Result<LogSummary, LogError>>>,
    dropped: Arc<AtomicU64>,
    dropped_since: u64,
    policy: u64,
    calls_seen: u64,
}

impl Logger {
    /// Starts a new log of a policy.
    ///
    /// # Errors
    /// [`LogError::Exists`], [`LogError::Io`] or [`LogError::Thread`].
    pub fn start(file: &Path, policy: &Policy, settings: LogSettings) -> Result<Self, LogError> {
        let opened = File::create_new(file).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => LogError::Exists { path: file.to_path_buf() },
            _ => LogError::Io { path: file.to_path_buf(), source },
        })?;
        let pool_ticks = settings.pool_ticks.max(1);
        let (full, filled) = sync_channel(pool_ticks);
        let (give_back, free) = sync_channel(pool_ticks);
        for _ in 0..pool_ticks {
            // Both ends are here and there is room for all of them.
            let _ = give_back.try_send(Box::new(Slot::new(policy)));
        }
        let worker = Worker::start(file, opened, &header(policy, settings))?;
        let dropped = Arc::new(AtomicU64::new(0));
        let dropped_in_all = Arc::clone(&dropped);
        let thread = std::thread::Builder::new()
            .name("log".into())
            .spawn(move || worker.run(&filled, &give_back, &dropped_in_all))
            .map_err(|error| LogError::Thread(error.to_string()))?;
        Ok(Self {
            file: file.to_path_buf(),
            full: Some(full),
            free,
            thread: Some(thread),
            dropped,
            dropped_since: 0,
            policy: policy.number(),
            calls_seen: 0,
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
    /// The first error of the writing thread; what it had written by then is in the file.
    pub fn finish(mut self) -> Result<LogSummary, LogError> {
        self.full = None;
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) => Err(LogError::Thread("the writing thread panicked".into())),
            None => Ok(LogSummary { file: self.file, ..LogSummary::default() }),
        }
    }

    /// An empty buffer. In lock-step it is waited for.
    fn take_slot(&self, lockstep: bool) -> Option<Box<Slot>> {
        if lockstep { self.free.recv().ok() } else { self.free.try_recv().ok() }
    }

    /// Copies the tick; allocates nothing unless the policy was exchanged for one of another bundle.
    fn fill(&mut self, slot: &mut Slot, tick: &Tick<'_>) {
        let policy = tick.policy;
        let exchanged = policy.number() != self.policy;
        if exchanged {
            (self.policy, self.calls_seen) = (policy.number(), 0);
        }
        slot.other_bundle = exchanged.then(|| BundleIdentity::of(policy.manifest()));
        slot.observed = tick.observation.is_some();
        if let Some(observation) = tick.observation {
            slot.observation.clone_from(observation);
        }
        (slot.is_first, slot.overtaken, slot.times) = (tick.is_first, tick.overtaken, tick.times);
        slot.answer = tick.answer;
        slot.calls.clear();
        slot.calls.extend(policy.calls_since(self.calls_seen).copied());
        let forgotten = policy.calls_made() - self.calls_seen > slot.calls.len() as u64;
        slot.resumes = self.dropped_since > 0 || forgotten;
        slot.dropped_before = self.dropped_since;
        slot.state.clone_from(policy.state());
        slot.noise_position = policy.noise_position();
        (self.calls_seen, self.dropped_since) = (policy.calls_made(), 0);
    }
}

impl TickObserver for Logger {
    fn ticked(&mut self, tick: &Tick<'_>) {
        if self.full.is_none() {
            return;
        }
        let lockstep = tick.observation.is_some_and(|observation| observation.period_ns == 0);
        let Some(mut slot) = self.take_slot(lockstep) else {
            self.dropped_since += 1;
            self.dropped.fetch_add(1, Ordering::Relaxed);
            return;
        };
        self.fill(&mut slot, tick);
        if let Some(full) = &self.full
            && full.send(slot).is_err()
        {
            // The thread has ended with an error, which `finish` will report.
            self.full = None;
        }
    }
}

fn header(policy: &Policy, settings: LogSettings) -> Header {
    let since_1970 = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    Header {
        program: env!("CARGO_PKG_VERSION").to_owned(),
        started_unix_s: since_1970.map_or(0, |time| time.as_secs()),
        instance: settings.instance,
        bundle: BundleIdentity::of(policy.manifest()),
        engine: settings.engine,
        sampling: settings.sampling,
        fallback: settings.fallback,
        rate_max: settings.rate_max,
        stages: STAGES.iter().map(ToString::to_string).collect(),
        machine: Machine::here(),
    }
}
