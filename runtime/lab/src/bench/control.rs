//! The control of the tails: arithmetic in registers that takes as long as a tick, run in the same rounds. It touches no memory, asks the
//! system for nothing and takes the same number of steps every time; that some of its runs are longer than others is all the machine's doing.

use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::BenchError;
use rcwm_kernels::team::{Job, Pieces, Team};
use rcwm_runtime::telemetry::{Stage, Telemetry};

/// Numbers that are worked on side by side: they fit into the registers of any x86, and keep its units for arithmetic busy, so that a
/// core that has to be shared shows.
const WIDTH: usize = 48;
/// Rounds of a step, in which they stay in the registers.
const ROUNDS: usize = 32;
/// Steps of the first guess at how long a step takes.
const GUESS_STEPS: u64 = 500;
/// Repetitions of the guess; the median counts.
const GUESSES: usize = 15;
/// How long the second thread looks for work: hardly, for it must not be in the way of what is measured next.
const HELPER_SPINS: Duration = Duration::from_micros(20);

/// What was measured of the control.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ControlBench {
    /// Threads that did it at once; the time is that of the slower one.
    pub threads: usize,
    /// Median.
    pub p50_us: f64,
    /// 99 of 100 are at most this.
    pub p99_us: f64,
    /// 999 of 1000 are at most this.
    pub p999_us: f64,
    /// Longest.
    pub max_us: f64,
    /// Three-nines over median: on a quiet machine little more than 1.
    pub p999_over_p50: f64,
}

impl ControlBench {
    /// For people.
    pub(super) fn line(&self) -> String {
        let Self { threads, p50_us, p99_us, p999_us, max_us, p999_over_p50 } = self;
        format!(
            "control    {threads} thread(s), arithmetic in registers: p50 {p50_us:.1} us, p99 {p99_us:.1}, p99.9 {p999_us:.1}, max \
             {max_us:.1}; p999_over_p50 {p999_over_p50:.2} is the machine's own\n"
        )
    }
}

/// Arithmetic on one thread or on two.
pub(super) struct Control {
    team: Option<(Team, Arc<Half>)>,
    steps: u64,
    telemetry: Telemetry,
}

impl Control {
    /// A control for ticks of this many threads, as long as those are in the median.
    pub(super) fn new(threads: usize, length: Duration) -> Result<Self, BenchError> {
        let team = (threads > 1).then(|| Team::start(HELPER_SPINS)).transpose();
        let team = team.map_err(|error| BenchError::Machine(error.to_string()))?;
        let team = team.map(|team| (team, Arc::default()));
        let mut control = Self { team, steps: GUESS_STEPS, telemetry: Telemetry::new() };
        let mut guesses: Vec<Duration> = (0..GUESSES).map(|_| control.run()).collect();
        guesses.sort_unstable();
        let guess_ns = guesses[GUESSES / 2].as_nanos().max(1) as f64;
        control.steps = ((length.as_nanos() as f64 / guess_ns * GUESS_STEPS as f64) as u64).max(1);
        Ok(control)
    }

    /// Once unmeasured, as caches are warmed before a tick, so that a second thread is awake; then once more.
    pub(super) fn measure(&mut self) {
        if self.team.is_some() {
            self.run();
        }
        let time = self.run();
        self.telemetry.record(Stage::Tick, time.as_nanos() as u64);
    }

    fn run(&mut self) -> Duration {
        let (start, steps) = (Instant::now(), self.steps);
        match &self.team {
            None => arithmetic(steps),
            Some((team, half)) => half.run(team, steps),
        }
        start.elapsed()
    }

    pub(super) fn report(&self) -> ControlBench {
        let times = self.telemetry.latency(Stage::Tick);
        ControlBench {
            threads: 1 + usize::from(self.team.is_some()),
            p50_us: times.p50_us,
            p99_us: times.p99_us,
            p999_us: times.p999_us,
            max_us: times.max_us,
            p999_over_p50: times.p999_us / times.p50_us,
        }
    }
}

/// The same arithmetic for each of two threads. The second is waited for: how late it comes is what is measured.
#[derive(Default)]
struct Half {
    pieces: Pieces,
    steps: AtomicU64,
    done: AtomicUsize,
}

impl Half {
    fn run(self: &Arc<Self>, team: &Team, steps: u64) {
        self.steps.store(steps, Ordering::Relaxed);
        self.done.store(0, Ordering::Relaxed);
        self.pieces.lay_out(2);
        team.send(Arc::clone(self) as Arc<dyn Job>);
        while self.pieces.claim_front().is_some() {
            arithmetic(steps);
            self.done.fetch_add(1, Ordering::Release);
        }
        while self.done.load(Ordering::Acquire) < 2 {
            std::hint::spin_loop();
        }
    }
}

impl Job for Half {
    fn help(&self) {
        while self.pieces.claim_back().is_some() {
            arithmetic(self.steps.load(Ordering::Relaxed));
            self.done.fetch_add(1, Ordering::Release);
        }
    }
}

fn arithmetic(steps: u64) {
    let mut numbers = [1.0_f32; WIDTH];
    for _ in 0..steps {
        for _ in 0..ROUNDS {
            for number in &mut numbers {
                *number = *number * 0.999 + 0.001;
            }
        }
        // So that the loop is not worked out beforehand.
        numbers = black_box(numbers);
    }
    black_box(numbers);
}
