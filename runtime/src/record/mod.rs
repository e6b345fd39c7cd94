//! One record a tick, from the loop to the one thread that writes.
//!
//! The loop copies a tick into a buffer of a fixed pool after its action was sent, and allocates nothing. Everything else, the log, the
//! snapshots, the live line, is made from the records by **sinks** in one other thread, which looks for records every [`LOOK`], so that
//! the loop need not wake it. In lock-step an empty pool makes the loop wait; in real time the tick is dropped, counted, and told in the
//! next record.

#[expect(clippy::module_inception, reason = "the module is called as what it hands over")]
mod record;

pub use record::{Record, RunningPolicy};

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::wire::Format;

use crate::controller::{Tick, TickObserver};
use crate::policy::Policy;
use record::Progress;

/// How often the writer looks for records.
const LOOK: Duration = Duration::from_millis(20);
/// Niceness of the writer, as of all that must not take the processor from the loop: Linux keeps one per thread.
const NICENESS: i32 = 10;

/// Most bytes of all observations that wait for the writer, and records that may wait however many bytes they take.
const WAITING_BYTES_MAX: usize = 32 << 20;
const WAITING_MIN: usize = 4;

/// Records that may wait of a robot with these observations.
fn records_of(format: &Format) -> usize {
    (WAITING_BYTES_MAX / format.layout().observation_bytes.max(1)).max(WAITING_MIN)
}

/// Makes something of the records, in the writer's thread. What goes wrong is kept and told after the run: a sink that has failed takes
/// what comes and does nothing.
pub trait Sink: Send + 'static {
    /// Whether it looks at pictures and masks; without, they are not copied.
    fn wants_pictures(&self) -> bool;

    /// Takes a record; those of a run in their order.
    fn take(&mut self, record: &Record);

    /// Every 20 ms or so; `dropped` ticks so far have no record.
    fn pause(&mut self, dropped: u64);
}

/// Hands a record of every tick to a sink.
pub struct Recorder<S> {
    full: Option<SyncSender<Box<Record>>>,
    /// Records that come back from the writer, and those that have.
    back: Receiver<Box<Record>>,
    #[expect(clippy::vec_box, reason = "records are handed to and fro, not copied")]
    free: Vec<Box<Record>>,
    /// Records that there are, free or not.
    records: usize,
    thread: Option<JoinHandle<S>>,
    dropped: Arc<AtomicU64>,
    progress: Progress,
    pictures: bool,
}

/// What a recorder leaves behind.
#[derive(Debug)]
pub struct Finished<S> {
    pub sink: S,
    /// Ticks that have no record.
    pub dropped: u64,
}

/// The writer has panicked, or could not be started.
#[derive(Debug, thiserror::Error)]
#[error("the thread that writes what is recorded {0}")]
pub struct WriterLost(String);

impl<S: Sink> Recorder<S> {
    /// Most records that may wait for the writer: half a second at 1 kHz. Of large observations it is fewer, 32 MiB of them.
    pub const RECORDS: usize = 512;

    pub fn start(policy: &Policy, sink: S) -> Result<Self, WriterLost> {
        Self::with_records(policy, sink, Self::RECORDS)
    }

    /// The same with another number of records that may wait at most.
    pub fn with_records(policy: &Policy, sink: S, records: usize) -> Result<Self, WriterLost> {
        let format = Format::of(policy.manifest().interface.clone());
        let records = records.clamp(1, records_of(&format));
        let (full, filled) = sync_channel(records);
        let (give_back, back) = sync_channel(records);
        let free = (0..records).map(|_| Box::new(Record::new(policy, &format))).collect();
        let (dropped, pictures) = (Arc::new(AtomicU64::new(0)), sink.wants_pictures());
        let dropped_so_far = Arc::clone(&dropped);
        let thread = std::thread::Builder::new()
            .name("writer".into())
            .spawn(move || write(sink, &filled, &give_back, &dropped_so_far))
            .map_err(|error| WriterLost(format!("could not be started: {error}")))?;
        let (full, thread, progress) = (Some(full), Some(thread), Progress::of(policy));
        Ok(Self { full, back, free, records, thread, dropped, progress, pictures })
    }

    /// A record that is free, where there are not more than `most`: those beyond are given up. A robot may offer more than the policy
    /// reads, and its observations take as much memory in every record that is filled.
    fn take_free(&mut self, most: usize, wait: bool) -> Option<Box<Record>> {
        loop {
            // The one that came back last is the likeliest to be in the caches.
            let free = self.free.pop().or_else(|| if wait { self.back.recv().ok() } else { None })?;
            if self.records <= most {
                return Some(free);
            }
            self.records -= 1;
        }
    }

    /// Waits until the sink has taken all records.
    pub fn finish(mut self) -> Result<Finished<S>, WriterLost> {
        self.full = None;
        let dropped = self.dropped.load(Ordering::Relaxed);
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(sink)) => Ok(Finished { sink, dropped }),
            Some(Err(_)) | None => Err(WriterLost("panicked; this is a bug of this program".into())),
        }
    }
}

impl<S: Sink> TickObserver for Recorder<S> {
    fn ticked(&mut self, tick: &Tick<'_>) {
        if self.full.is_none() {
            return;
        }
        let lockstep = tick.observation.is_some_and(|observation| observation.period_ns == 0);
        self.free.extend(self.back.try_iter());
        let most = tick.observation.map_or(usize::MAX, |observation| records_of(observation.format()));
        let Some(mut record) = self.take_free(most, lockstep) else {
            self.progress.dropped += 1;
            self.dropped.fetch_add(1, Ordering::Relaxed);
            return;
        };
        record.fill(&mut self.progress, tick, self.pictures);
        if self.full.as_ref().is_some_and(|full| full.send(record).is_err()) {
            // The writer has panicked, which `finish` will report.
            self.full = None;
        }
    }
}

fn write<S: Sink>(
    mut sink: S,
    filled: &Receiver<Box<Record>>,
    give_back: &SyncSender<Box<Record>>,
    dropped: &AtomicU64,
) -> S {
    // Where that is not granted, it is written as fast as may be.
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
    let mut paused = Instant::now();
    loop {
        let next = filled.try_recv();
        if paused.elapsed() >= LOOK {
            sink.pause(dropped.load(Ordering::Relaxed));
            paused = Instant::now();
        }
        match next {
            Ok(record) => {
                sink.take(&record);
                // The loop may have ended; then nobody needs it back.
                let _ = give_back.try_send(record);
            }
            Err(TryRecvError::Empty) => std::thread::sleep(LOOK),
            Err(TryRecvError::Disconnected) => return sink,
        }
    }
}
