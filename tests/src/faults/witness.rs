//! Sees everything that goes over the wire, and judges it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::wire::{Action, ActionObserverLink, ActionSource, LinkSettings, ObserverLink, Wait};

use crate::TIMEOUT;

/// Time between two looks, far below any period used here.
const LOOK: Duration = Duration::from_micros(100);
/// An observation is known to the controller so long after it was published.
const ON_THE_WAY_NS: u64 = 1_000_000;

/// An observation, without its image.
#[derive(Debug, Clone, Copy)]
pub struct Published {
    /// Who published it.
    pub publisher: u128,
    pub sequence: u64,
    /// When it was due.
    pub scheduled_ns: u64,
    /// When it was published.
    pub published_ns: u64,
}

/// All that went over the wire, each in the order of its time of publication.
#[derive(Debug, Clone, Default)]
pub struct Record {
    pub observations: Vec<Published>,
    pub actions: Vec<Action>,
}

/// Listens in on both directions in a thread of its own.
pub struct Witness {
    record: Arc<Mutex<Record>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Witness {
    /// Joins an instance.
    #[must_use]
    pub fn start(settings: LinkSettings) -> Self {
        let (record, stop) = (Arc::<Mutex<Record>>::default(), Arc::<AtomicBool>::default());
        let (into, stopped) = (Arc::clone(&record), Arc::clone(&stop));
        let joined = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&joined);
        let thread = std::thread::spawn(move || {
            // Ports stay in the thread that made them.
            let observations = ObserverLink::open(settings.clone()).expect("the instance can be joined");
            let actions = ActionObserverLink::open(&settings).expect("the instance can be joined");
            told.store(true, Ordering::Release);
            while !stopped.load(Ordering::Relaxed) {
                look(&observations, &actions, &into);
            }
        });
        crate::eventually("the witness has joined", || joined.load(Ordering::Acquire));
        Self { record, stop, thread: Some(thread) }
    }

    /// All so far.
    #[must_use]
    pub fn record(&self) -> Record {
        self.record.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The first action published after `time_ns` that fits.
    ///
    /// # Panics
    /// When none comes within [`TIMEOUT`].
    #[must_use]
    pub fn action_after(&self, time_ns: u64, what: &str, fits: impl Fn(&Action) -> bool) -> Action {
        let start = Instant::now();
        while start.elapsed() < TIMEOUT {
            let record = self.record.lock().unwrap_or_else(PoisonError::into_inner);
            let later = record.actions.iter().rev().take_while(|action| action.published_ns > time_ns);
            if let Some(action) = later.filter(|action| fits(action)).last() {
                return *action;
            }
            drop(record);
            std::thread::sleep(LOOK);
        }
        panic!("{what}: no such action within {TIMEOUT:?}");
    }

    /// The last observation so far.
    #[must_use]
    pub fn last_observation(&self) -> Option<Published> {
        self.record.lock().unwrap_or_else(PoisonError::into_inner).observations.last().copied()
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It has panicked only if the test fails for the same reason.
            let _ = thread.join();
        }
    }
}

fn look(observations: &ObserverLink, actions: &ActionObserverLink, record: &Mutex<Record>) {
    let observed = observations.wait_observation(LOOK).expect("the link works");
    let action = actions.poll_action().expect("the link works");
    let mut record = record.lock().unwrap_or_else(PoisonError::into_inner);
    if let Wait::Message(observation) = observed {
        record.observations.push(Published {
            publisher: observation.origin(),
            sequence: observation.sequence,
            scheduled_ns: observation.scheduled_ns,
            published_ns: observation.published_ns,
        });
    }
    record.actions.extend(action);
}

/// An action that came too late.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Stale {
    pub answers: u64,
    /// The newest observation by then.
    pub newest: u64,
    pub source: u32,
    /// How long after the newest it was published, in us.
    pub after_us: u64,
}

/// What was found on the wire that must not be there.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct Verdict {
    /// Actions seen.
    pub actions: usize,
    /// Of them, by their source: the policy, imagined, fallback.
    pub sources: [usize; 3],
    /// Actions with a value that is not finite or not within [-1, 1].
    pub invalid: usize,
    /// Actions that answer an observation although a newer one had been published for a millisecond.
    pub stale: Vec<Stale>,
}

impl Record {
    /// Judges every action on the wire.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        let mut verdict = Verdict { actions: self.actions.len(), ..Verdict::default() };
        for action in &self.actions {
            verdict.invalid += usize::from(!action.action.iter().all(|x| (-1.0..=1.0).contains(x)));
            verdict.stale.extend(self.stale(action));
            if let Some(source) = ActionSource::from_wire(action.source) {
                verdict.sources[source as usize] += 1;
            }
        }
        verdict
    }

    /// Compares with what the same simulator had published: the first observations of the next one may have escaped the witness.
    fn stale(&self, action: &Action) -> Option<Stale> {
        let before = |time_ns: u64| self.observations.partition_point(|seen| seen.published_ns <= time_ns);
        let publisher = match self.observations.get(before(action.published_ns)) {
            Some(next) => next.publisher,
            None => self.observations.last()?.publisher,
        };
        let known = &self.observations[..before(action.published_ns.saturating_sub(ON_THE_WAY_NS))];
        let own = known.iter().filter(|seen| seen.publisher == publisher);
        let newest = own.max_by_key(|seen| seen.sequence)?;
        (action.answers < newest.sequence).then(|| Stale {
            answers: action.answers,
            newest: newest.sequence,
            source: action.source,
            after_us: (action.published_ns - newest.published_ns) / 1000,
        })
    }
}
