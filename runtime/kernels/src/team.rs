//! A second thread for the tick.
//!
//! The calling thread sends the helper with a job and goes on with its own share. Everything that the helper touches belongs to the job, so that
//! nobody has to wait for it: whoever has waited long enough does the helper's share as well, and what the helper brings later is
//! dropped. Between jobs the helper spins for a while, then sleeps.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::{JoinHandle, Thread};
use std::time::{Duration, Instant};

/// Name of the helper's thread, as the system shows it.
pub const HELPER_NAME: &str = "rcwm-tick";
/// Spins between two looks at the clock.
const SPINS: u32 = 64;
/// The helper is late when it was waited for at least so long: two cores are seldom equally fast.
pub const TIMEOUT_MIN: Duration = Duration::from_micros(15);

/// What the helper can be sent to do.
pub trait Job: Send + Sync {
    /// Does it. May come late, or once more: a job knows itself whether there is still something to do.
    fn help(&self);
}

/// What both threads share.
#[derive(Default)]
struct Shared {
    job: Mutex<Option<Arc<dyn Job>>>,
    wanted: AtomicBool,
    late: AtomicBool,
    asleep: AtomicBool,
    ends: AtomicBool,
}

impl Shared {
    /// The helper's life.
    fn help(&self, spin: Duration) {
        let mut idle_since = Instant::now();
        while !self.ends.load(Ordering::Acquire) {
            if self.take() {
                self.run();
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

    /// Whether there is a job; whoever is told so has it.
    fn take(&self) -> bool {
        self.wanted.load(Ordering::Relaxed) && self.wanted.swap(false, Ordering::AcqRel)
    }

    fn run(&self) {
        let job = self.job.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(job) = job {
            // Whoever waits for it sees that it has brought nothing, and does it without the helper.
            let _ = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| job.help()));
        }
    }

    fn sleep(&self) {
        self.asleep.store(true, Ordering::SeqCst);
        // A job that was sent in between is seen here, or its sender sees `asleep`.
        if !self.wanted.load(Ordering::SeqCst) && !self.ends.load(Ordering::SeqCst) {
            std::thread::park();
        }
        self.asleep.store(false, Ordering::SeqCst);
    }
}

/// The calling thread's end, and its helper. One thread at a time sends jobs.
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
    /// Starts the helper; it spins this long after a job before it sleeps.
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

    /// Wakes the helper, so that it is there when a job comes.
    pub fn wake(&self) {
        if self.shared.asleep.load(Ordering::SeqCst) {
            self.thread.unpark();
        }
    }

    /// Sends the helper, which begins as soon as it has nothing else to do. A job that it has not begun by then is forgotten.
    pub fn send(&self, job: Arc<dyn Job>) {
        // The helper holds it for a moment only; where it was stopped in that moment it will not come anyway.
        if let Some(mut place) = try_lock(&self.shared.job) {
            *place = Some(job);
            drop(place);
            self.shared.wanted.store(true, Ordering::SeqCst);
            self.wake();
        }
    }

    /// Calls the job off; whether the helper had not begun it.
    pub fn call_off(&self) -> bool {
        self.shared.take()
    }

    /// Notes that the helper was not waited for.
    pub fn note_late(&self) {
        self.shared.late.store(true, Ordering::Relaxed);
    }

    /// Whether the helper was late since the last time this was asked.
    pub fn take_late(&self) -> bool {
        self.shared.late.swap(false, Ordering::Relaxed)
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::SeqCst);
        self.thread.unpark();
        if let Some(helper) = self.helper.take() {
            // It has no panics of its own.
            let _ = helper.join();
        }
    }
}

/// None while somebody else is at it.
pub fn try_lock<T>(mutex: &Mutex<T>) -> Option<MutexGuard<'_, T>> {
    match mutex.try_lock() {
        Ok(guard) => Some(guard),
        Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
        Err(TryLockError::WouldBlock) => None,
    }
}

/// Numbered pieces that two threads claim from both ends until they meet.
#[derive(Debug, Default)]
pub struct Pieces {
    /// The next from the front (low half), and the one behind the next from the back (high half).
    ends: AtomicU64,
}

impl Pieces {
    /// Lays out `count` pieces. What was claimed before is forgotten.
    pub fn lay_out(&self, count: u32) {
        self.ends.store(u64::from(count) << 32, Ordering::Release);
    }

    /// The next piece from the front.
    pub fn claim_front(&self) -> Option<usize> {
        self.claim(|front, back| (front + 1, back)).map(|(front, _)| front)
    }

    /// The next piece from the back.
    pub fn claim_back(&self) -> Option<usize> {
        self.claim(|front, back| (front, back - 1)).map(|(_, back)| back - 1)
    }

    /// How many were claimed from the front; once all are claimed, the first that was claimed from the back.
    pub fn front(&self) -> usize {
        (self.ends.load(Ordering::Acquire) & 0xffff_ffff) as usize
    }

    /// Both ends before the claim.
    fn claim(&self, claimed: impl Fn(u64, u64) -> (u64, u64)) -> Option<(usize, usize)> {
        let apart = |ends: u64| (ends & 0xffff_ffff, ends >> 32);
        let before = self.ends.fetch_update(Ordering::AcqRel, Ordering::Acquire, |ends| {
            let (front, back) = apart(ends);
            (front < back).then(|| {
                let (front, back) = claimed(front, back);
                back << 32 | front
            })
        });
        before.ok().map(apart).map(|(front, back)| (front as usize, back as usize))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicUsize;

    #[derive(Default)]
    struct Counting(AtomicUsize);

    impl Job for Counting {
        fn help(&self) {
            self.0.fetch_add(1, Ordering::SeqCst);
        }
    }

    #[test]
    fn a_job_is_run_once_or_called_off() {
        for spin in [Duration::ZERO, Duration::from_millis(50)] {
            let team = Team::start(spin).unwrap();
            let job = Arc::new(Counting::default());
            for round in 1..2000_usize {
                let before = job.0.load(Ordering::SeqCst);
                team.send(Arc::clone(&job) as Arc<dyn Job>);
                let called_off = round % 2 == 0 && team.call_off();
                while !called_off && job.0.load(Ordering::SeqCst) == before {
                    std::hint::spin_loop();
                }
                assert_eq!(job.0.load(Ordering::SeqCst), before + usize::from(!called_off), "{round}");
            }
        }
    }

    #[test]
    fn every_piece_is_claimed_once_from_one_of_the_ends() {
        const COUNT: u32 = 100_000;
        let pieces = Pieces::default();
        pieces.lay_out(COUNT);
        let (front, back) = std::thread::scope(|scope| {
            let back = scope.spawn(|| std::iter::from_fn(|| pieces.claim_back()).collect::<Vec<_>>());
            let front: Vec<_> = std::iter::from_fn(|| pieces.claim_front()).collect();
            (front, back.join().unwrap())
        });
        assert_eq!(pieces.front(), front.len());
        let all: Vec<_> = front.into_iter().chain(back.into_iter().rev()).collect();
        assert!(all.into_iter().eq(0..COUNT as usize));
    }

    #[test]
    fn a_helper_whose_job_panicked_does_the_next() {
        struct Panicking;
        impl Job for Panicking {
            fn help(&self) {
                panic!("on purpose");
            }
        }
        let team = Team::start(Duration::from_millis(1)).unwrap();
        let job = Arc::new(Counting::default());
        team.send(Arc::new(Panicking));
        while job.0.load(Ordering::SeqCst) == 0 {
            team.send(Arc::clone(&job) as Arc<dyn Job>);
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
