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

use crate::controller::{Tick, TickObserver};
use crate::policy::Policy;
use record::Progress;

/// How often the writer looks for records.
const LOOK: Duration = Duration::from_millis(20);
/// Niceness of the writer, as of all that must not take the processor from the loop: Linux keeps one per thread.
const NICENESS: i32 = 10;

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
    /// Records that may wait for the writer: half a second at 1 kHz, about 9 MB.
    pub const RECORDS: usize = 512;

    pub fn start(policy: &Policy, sink: S) -> Result<Self, WriterLost> {
        Self::with_records(policy, sink, Self::RECORDS)
    }

    /// The same with another number of records that may wait.
    pub fn with_records(policy: &Policy, sink: S, records: usize) -> Result<Self, WriterLost> {
        let records = records.max(1);
        let (full, filled) = sync_channel(records);
        let (give_back, back) = sync_channel(records);
        let free = (0..records).map(|_| Box::new(Record::new(policy))).collect();
        let (dropped, pictures) = (Arc::new(AtomicU64::new(0)), sink.wants_pictures());
        let dropped_so_far = Arc::clone(&dropped);
        let thread = std::thread::Builder::new()
            .name("writer".into())
            .spawn(move || write(sink, &filled, &give_back, &dropped_so_far))
            .map_err(|error| WriterLost(format!("could not be started: {error}")))?;
        let (full, thread, progress) = (Some(full), Some(thread), Progress::of(policy));
        Ok(Self { full, back, free, thread, dropped, progress, pictures })
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
        let Some(full) = &self.full else { return };
        let lockstep = tick.observation.is_some_and(|observation| observation.period_ns == 0);
        self.free.extend(self.back.try_iter());
        // The one that came back last is the likeliest to be in the caches.
        let free = self.free.pop().or_else(|| if lockstep { self.back.recv().ok() } else { None });
        let Some(mut record) = free else {
            self.progress.dropped += 1;
            self.dropped.fetch_add(1, Ordering::Relaxed);
            return;
        };
        record.fill(&mut self.progress, tick, self.pictures);
        if full.send(record).is_err() {
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
