//! A second thread for the tick.
//!
//! The calling thread publishes a piece of work as numbered chunks and begins to claim them; the helper, where it is awake, claims from the
//! other end of the same counter. A chunk is run by whoever claimed it, so that a helper that sleeps or was preempted before it claimed
//! anything costs nothing: the caller does all of it. Between ticks the helper spins for a while, then sleeps.
//!
//! An errand is what only the helper does, on what belongs to it: its caller need not wait for it.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::{JoinHandle, Thread};
use std::time::{Duration, Instant};

/// Name of the helper's thread, as the system shows it.
pub const HELPER_NAME: &str = "rcwm-tick";
/// Most chunks of a piece of work.
const CHUNKS_MAX: usize = 0xffff;
/// Bits of the ticket that hold the next chunk, and the number of chunks.
const BITS: u32 = 16;
/// Spins between two looks at the clock.
const SPINS: u32 = 64;

type Work<'a> = &'a (dyn Fn(usize) + Sync);
type Errand = Box<dyn Fn() + Send + Sync>;

/// What both threads share.
#[derive(Default)]
struct Shared {
    /// Generation (32 bits), number of chunks (16), next chunk (16), in one word: claiming a chunk of old work cannot succeed.
    ticket: AtomicU64,
    /// Address and table of the work; valid while a claimed chunk of its generation is not done.
    work: [AtomicUsize; 2],
    done: AtomicUsize,
    panicked: AtomicBool,
    errand: OnceLock<Errand>,
    errand_wanted: AtomicBool,
    asleep: AtomicBool,
    ends: AtomicBool,
}

impl Shared {
    fn claim(&self) -> Option<usize> {
        let mut ticket = self.ticket.load(Ordering::Acquire);
        loop {
            let (next, chunks) = (ticket & 0xffff, (ticket >> BITS) & 0xffff);
            if next >= chunks {
                return None;
            }
            match self.ticket.compare_exchange_weak(ticket, ticket + 1, Ordering::AcqRel, Ordering::Acquire) {
                Ok(_) => return Some(next as usize),
                Err(now) => ticket = now,
            }
        }
    }

    /// Runs a claimed chunk.
    fn run(&self, chunk: usize) {
        let work = self.work.each_ref().map(|part| part.load(Ordering::Acquire));
        // SAFETY: the two words are those of a `Work` that `Team::each` stored before it published the ticket this chunk was
        // claimed from, and `Team::each` does not return before all claimed chunks are done.
        let work: Work<'_> = unsafe { std::mem::transmute::<[usize; 2], Work<'_>>(work) };
        if std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| work(chunk))).is_err() {
            self.panicked.store(true, Ordering::Release);
        }
        self.done.fetch_add(1, Ordering::Release);
    }

    /// The helper's life.
    fn help(&self, spin: Duration) {
        let mut idle_since = Instant::now();
        while !self.ends.load(Ordering::Acquire) {
            if let Some(chunk) = self.claim() {
                self.run(chunk);
                idle_since = Instant::now();
                continue;
            }
            if self.take_errand() {
                self.run_errand();
                idle_since = Instant::now();
                continue;
            }
            for _ in 0..SPINS {
                std::hint::spin_loop();
            }
            if idle_since.elapsed() >= spin {
                self.sleep();
                idle_since = Instant::now();
            }
        }
    }

    /// Whether there is an errand; whoever is told so has it.
    fn take_errand(&self) -> bool {
        self.errand_wanted.load(Ordering::Relaxed) && self.errand_wanted.swap(false, Ordering::AcqRel)
    }

    fn run_errand(&self) {
        if let Some(errand) = self.errand.get() {
            // Whoever waits for it sees that it has brought nothing, and does it without the helper.
            let _ = std::panic::catch_unwind(std::panic::AssertUnwindSafe(errand));
        }
    }

    fn sleep(&self) {
        self.asleep.store(true, Ordering::SeqCst);
        // Work that was published in between is seen here, or its publisher sees `asleep`.
        let ticket = self.ticket.load(Ordering::SeqCst);
        let nothing =
            ticket & 0xffff >= (ticket >> BITS) & 0xffff && !self.errand_wanted.load(Ordering::SeqCst);
        if nothing && !self.ends.load(Ordering::SeqCst) {
            std::thread::park();
        }
        self.asleep.store(false, Ordering::SeqCst);
    }
}

/// The calling thread and its helper.
pub struct Team {
    shared: Arc<Shared>,
    helper: Option<JoinHandle<()>>,
    thread: Thread,
}

impl std::fmt::Debug for Team {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Team")
    }
}

impl Team {
    /// Starts the helper; it spins this long after work before it sleeps.
    ///
    /// # Errors
    /// What the operating system says.
    pub fn start(spin: Duration) -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let helper = std::thread::Builder::new().name(HELPER_NAME.into()).spawn({
            let shared = Arc::clone(&shared);
            move || shared.help(spin)
        })?;
        let thread = helper.thread().clone();
        Ok(Self { shared, helper: Some(helper), thread })
    }

    /// Wakes the helper, so that it is there when work comes.
    pub fn wake(&self) {
        if self.shared.asleep.load(Ordering::SeqCst) {
            self.thread.unpark();
        }
    }

    /// What [`Self::send`] sends the helper to do; a second errand is refused.
    ///
    /// # Errors
    /// The errand, where there is one already.
    pub fn set_errand(&self, errand: Errand) -> Result<(), Errand> {
        self.shared.errand.set(errand)
    }

    /// Sends the helper on its errand, which it begins as soon as it has nothing else to do.
    pub fn send(&self) {
        self.shared.errand_wanted.store(true, Ordering::SeqCst);
        self.wake();
    }

    /// Calls the errand off; whether the helper had not begun it.
    pub fn call_off(&self) -> bool {
        self.shared.take_errand()
    }

    /// Runs `work(0)` to `work(chunks - 1)`, in any order, on both threads. Only one thread may call this at a time; `&mut` makes sure.
    ///
    /// # Panics
    /// If a chunk panics, after all of them are done.
    pub fn each(&mut self, chunks: usize, work: Work<'_>) {
        assert!(chunks <= CHUNKS_MAX, "team: {chunks} chunks");
        let shared = &*self.shared;
        // SAFETY: only the lifetime is forgotten. Nobody reads the words after this function has returned: a chunk can be claimed
        // only while the ticket is of this generation, and all of them are done before that.
        let words = unsafe { std::mem::transmute::<Work<'_>, [usize; 2]>(work) };
        for (place, word) in shared.work.iter().zip(words) {
            place.store(word, Ordering::Relaxed);
        }
        shared.done.store(0, Ordering::Relaxed);
        let generation = (shared.ticket.load(Ordering::Relaxed) >> (2 * BITS)).wrapping_add(1) & 0xffff_ffff;
        shared.ticket.store(generation << (2 * BITS) | (chunks as u64) << BITS, Ordering::SeqCst);
        self.wake();
        while let Some(chunk) = shared.claim() {
            shared.run(chunk);
        }
        while shared.done.load(Ordering::Acquire) < chunks {
            std::hint::spin_loop();
        }
        assert!(!shared.panicked.swap(false, Ordering::AcqRel), "team: a chunk panicked");
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::SeqCst);
        self.thread.unpark();
        if let Some(helper) = self.helper.take() {
            // It has no panics of its own; those of chunks were passed on.
            let _ = helper.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_chunk_runs_once_whether_the_helper_sleeps_or_not() {
        for spin in [Duration::ZERO, Duration::from_millis(50)] {
            let mut team = Team::start(spin).unwrap();
            for round in 0..2000_usize {
                let chunks = round % 9;
                let runs: Vec<AtomicUsize> = (0..chunks).map(|_| AtomicUsize::new(0)).collect();
                team.each(chunks, &|chunk| {
                    runs[chunk].fetch_add(1, Ordering::Relaxed);
                });
                assert!(runs.iter().all(|runs| runs.load(Ordering::Relaxed) == 1), "{round}: {runs:?}");
            }
        }
    }

    #[test]
    fn an_errand_is_run_once_or_called_off() {
        for spin in [Duration::ZERO, Duration::from_millis(50)] {
            let mut team = Team::start(spin).unwrap();
            let runs = Arc::new(AtomicUsize::new(0));
            let errand = Arc::clone(&runs);
            let set = team.set_errand(Box::new(move || {
                errand.fetch_add(1, Ordering::SeqCst);
            }));
            assert!(set.is_ok() && team.set_errand(Box::new(|| {})).is_err());
            for round in 1..2000_usize {
                let before = runs.load(Ordering::SeqCst);
                team.send();
                if round % 3 == 0 {
                    team.each(2, &|_| {});
                }
                let called_off = round % 2 == 0 && team.call_off();
                while !called_off && runs.load(Ordering::SeqCst) == before {
                    std::hint::spin_loop();
                }
                assert_eq!(runs.load(Ordering::SeqCst), before + usize::from(!called_off), "{round}");
            }
        }
    }

    #[test]
    fn both_threads_work() {
        let mut team = Team::start(Duration::from_secs(1)).unwrap();
        let names = std::sync::Mutex::new(std::collections::BTreeSet::new());
        for _ in 0..200 {
            team.each(2, &|_| {
                std::thread::sleep(Duration::from_millis(1));
                names.lock().unwrap().insert(std::thread::current().name().map(String::from));
            });
        }
        assert_eq!(names.lock().unwrap().len(), 2);
    }

    #[test]
    fn a_panic_in_a_chunk_is_the_callers() {
        let mut team = Team::start(Duration::from_millis(1)).unwrap();
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            team.each(4, &|chunk| assert!(chunk != 2, "on purpose"));
        }));
        assert!(panicked.is_err());
        team.each(3, &|_| {});
    }
}
