//! The experiments, each so many times.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{Action, ActionSource};
use rcwm_runtime::controller::{Controller, ControllerSettings, Ended, Tick, TickObserver};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use rustix::process::Signal;
use serde::Serialize;

use super::bed::{Bed, ControllerOptions};
use super::peer::Fault;
use super::poison::poisoned_bundle;
use super::witness::{Record, Verdict};
use crate::shipped_bundle;

/// One kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Experiment {
    /// The simulator is killed (SIGKILL), and another one started.
    SimulatorKilled,
    /// The same with imagining switched off: straight to the fallback.
    SimulatorKilledNoImagining,
    /// The simulator is stopped (SIGSTOP) and continued (SIGCONT).
    SimulatorStopped,
    /// The controller is killed, and another one started.
    ControllerKilled,
    /// The controller is stopped for ten periods and continued.
    ControllerStopped,
    /// One observation of a hundred is lost.
    Dropped,
    /// One observation of a hundred comes three periods late.
    Delayed,
    /// One observation of a hundred comes twice.
    Doubled,
    /// The policy gives NaN for about half of the images.
    NotFinite,
    /// The tick is held up for three periods, every twentieth time.
    Stalled,
}

/// What came of an experiment.
#[derive(Debug, Clone, Serialize)]
pub struct Outcome {
    pub experiment: Experiment,
    /// How often the fault happened.
    pub rounds: usize,
    /// From the last observation before the fault (where the tick itself is at fault: from its own) to the first action that was not the
    /// policy's on an observation, in periods.
    pub stand_in_periods: Vec<f64>,
    /// The same to the first fallback action.
    pub fallback_periods: Vec<f64>,
    /// From the end of the fault to the next action of the policy on an observation, in ms.
    pub back_ms: Vec<f64>,
    /// What was seen on the wire.
    pub verdict: Verdict,
    /// Files left in shared memory.
    pub leftovers: Vec<String>,
    /// The controller's own counts; those of the last one where several were started.
    pub counters: serde_json::Value,
}

const EVERY: u64 = 100;
const DELAY_PERIODS: u64 = 3;
const STALL_PERIODS: u32 = 3;
const STALL_EVERY: u64 = 20;

impl Experiment {
    /// All, in the order of the table.
    pub const ALL: [Self; 10] = [
        Self::SimulatorKilled,
        Self::SimulatorKilledNoImagining,
        Self::SimulatorStopped,
        Self::ControllerKilled,
        Self::ControllerStopped,
        Self::Dropped,
        Self::Delayed,
        Self::Doubled,
        Self::NotFinite,
        Self::Stalled,
    ];

    /// Runs it.
    ///
    /// # Panics
    /// When a process does not start or the controller does not come back at all.
    #[must_use]
    pub fn run(self, rounds: usize, period: Duration) -> Outcome {
        let trial = Trial::new(self, period);
        match self {
            Self::SimulatorKilled => trial.simulator_killed(rounds, 5),
            Self::SimulatorKilledNoImagining => trial.simulator_killed(rounds, 0),
            Self::SimulatorStopped => trial.simulator_stopped(rounds),
            Self::ControllerKilled => trial.controller_killed(rounds),
            Self::ControllerStopped => trial.controller_stopped(rounds),
            Self::Dropped => trial.unreliable(rounds, Fault::Dropped { every: EVERY }),
            Self::Delayed => {
                trial.unreliable(rounds, Fault::Delayed { every: EVERY, periods: DELAY_PERIODS })
            }
            Self::Doubled => trial.unreliable(rounds, Fault::Doubled { every: EVERY }),
            Self::NotFinite => trial.not_finite(rounds),
            Self::Stalled => trial.stalled(rounds),
        }
    }
}

fn is(source: ActionSource) -> impl Fn(&Action) -> bool {
    move |action| action.source == source as u32
}

fn ms_since(time_ns: u64, action: &Action) -> f64 {
    action.published_ns.saturating_sub(time_ns) as f64 / 1e6
}

struct Trial {
    experiment: Experiment,
    bed: Bed,
    rounds: usize,
    stand_in_periods: Vec<f64>,
    fallback_periods: Vec<f64>,
    back_ms: Vec<f64>,
}

impl Trial {
    fn new(experiment: Experiment, period: Duration) -> Self {
        Self {
            experiment,
            bed: Bed::new(period),
            rounds: 0,
            stand_in_periods: Vec::new(),
            fallback_periods: Vec::new(),
            back_ms: Vec::new(),
        }
    }

    fn periods_since(&self, time_ns: u64, action: &Action) -> f64 {
        action.published_ns.saturating_sub(time_ns) as f64 / self.bed.period.as_nanos() as f64
    }

    /// Waits for the policy's next action; the time from `since_ns` to it counts as the way back.
    fn back(&mut self, since_ns: u64) {
        let action =
            self.bed.witness().action_after(since_ns, "the policy is back", is(ActionSource::Policy));
        self.back_ms.push(ms_since(since_ns, &action));
    }

    /// Lets some ticks pass, not always as many, so that faults hit at any moment of a period.
    fn go_on(&self, round: usize) {
        std::thread::sleep(self.bed.period * 5 + self.bed.period * (round as u32 % 7) / 7);
    }

    /// Waits for what replaces the policy after the last observation.
    fn silence(&mut self) {
        let witness = self.bed.witness();
        // The witness hears of the last one a moment later.
        std::thread::sleep(Duration::from_millis(2));
        let Some(last) = witness.last_observation() else { return };
        let stand_in = witness.action_after(last.published_ns, "something stands in", |action| {
            !is(ActionSource::Policy)(action)
        });
        let fallback = witness.action_after(last.published_ns, "the fallback", is(ActionSource::Fallback));
        self.stand_in_periods.push(self.periods_since(last.published_ns, &stand_in));
        self.fallback_periods.push(self.periods_since(last.published_ns, &fallback));
    }

    fn finish(self, counters: serde_json::Value) -> Outcome {
        let verdict = self.bed.witness().record().verdict();
        Outcome {
            experiment: self.experiment,
            rounds: self.rounds,
            stand_in_periods: self.stand_in_periods,
            fallback_periods: self.fallback_periods,
            back_ms: self.back_ms,
            verdict,
            leftovers: self.bed.leave(),
            counters,
        }
    }

    fn simulator_killed(mut self, rounds: usize, imagined_ticks_max: u32) -> Outcome {
        let options = ControllerOptions { imagined_ticks_max, ..ControllerOptions::default() };
        let controller = self.bed.start_controller(&options);
        for round in 0..rounds {
            let before_ns = monotonic_ns();
            let peer = self.bed.start_peer();
            crate::eventually("the simulator publishes", || {
                self.bed.witness().last_observation().is_some_and(|last| last.published_ns > before_ns)
            });
            let published = self.bed.witness().record().observations;
            let first = published.iter().find(|seen| seen.published_ns > before_ns);
            // The first controller has to load its bundle as well.
            if round > 0 {
                self.back(first.map_or(before_ns, |first| first.published_ns));
            } else {
                let _ = self.bed.witness().action_after(before_ns, "the first", is(ActionSource::Policy));
            }
            self.go_on(round);
            peer.kill();
            self.silence();
            self.rounds += 1;
        }
        let report = self.bed.end_controller(controller);
        self.finish(report["counters"].clone())
    }

    fn simulator_stopped(mut self, rounds: usize) -> Outcome {
        let controller = self.bed.start_controller(&ControllerOptions::default());
        let peer = self.bed.start_peer();
        let _ = self.bed.witness().action_after(0, "the first", is(ActionSource::Policy));
        for round in 0..rounds {
            self.go_on(round);
            peer.signal(Signal::STOP);
            self.silence();
            let continued_ns = monotonic_ns();
            peer.signal(Signal::CONT);
            self.back(continued_ns);
            self.rounds += 1;
        }
        let report = self.bed.end_controller(controller);
        peer.kill();
        self.finish(report["counters"].clone())
    }

    fn controller_killed(mut self, rounds: usize) -> Outcome {
        let peer = self.bed.start_peer();
        for round in 0..rounds {
            let started_ns = monotonic_ns();
            let controller = self.bed.start_controller(&ControllerOptions::default());
            self.back(started_ns);
            self.go_on(round);
            controller.kill();
            self.rounds += 1;
        }
        peer.kill();
        self.finish(serde_json::Value::Null)
    }

    fn controller_stopped(mut self, rounds: usize) -> Outcome {
        let controller = self.bed.start_controller(&ControllerOptions::default());
        let peer = self.bed.start_peer();
        let _ = self.bed.witness().action_after(0, "the first", is(ActionSource::Policy));
        for round in 0..rounds {
            self.go_on(round);
            controller.signal(Signal::STOP);
            std::thread::sleep(self.bed.period * 10);
            let continued_ns = monotonic_ns();
            controller.signal(Signal::CONT);
            self.back(continued_ns);
            self.rounds += 1;
        }
        let report = self.bed.end_controller(controller);
        peer.kill();
        self.finish(report["counters"].clone())
    }

    fn unreliable(mut self, rounds: usize, fault: Fault) -> Outcome {
        let controller = self.bed.start_controller(&ControllerOptions::default());
        let served = self.bed.start_faulty_peer(fault, rounds).served();
        let report = self.bed.end_controller(controller);
        let record = self.bed.witness().record();
        self.rounds = served.hit.len();
        if !matches!(fault, Fault::Doubled { .. }) {
            for sequence in served.hit {
                self.missing(&record, sequence);
            }
        }
        self.finish(report["counters"].clone())
    }

    /// What was answered when this observation was missing.
    fn missing(&mut self, record: &Record, sequence: u64) {
        let last = record.observations.iter().rev().find(|seen| seen.sequence + 1 == sequence);
        let stand_in = record
            .actions
            .iter()
            .find(|action| action.answers == sequence && !is(ActionSource::Policy)(action));
        if let (Some(last), Some(stand_in)) = (last, stand_in) {
            self.stand_in_periods.push(self.periods_since(last.published_ns, stand_in));
        }
    }

    fn not_finite(mut self, rounds: usize) -> Outcome {
        let poisoned = poisoned_bundle();
        let bundle = poisoned.path().to_path_buf();
        let options = ControllerOptions { bundle, fallback_ticks_max: 1000, ..ControllerOptions::default() };
        let controller = self.bed.start_controller(&options);
        let peer = self.bed.start_faulty_peer(Fault::None, usize::MAX);
        crate::eventually("enough fallbacks", || {
            self.bed.witness().record().verdict().sources[ActionSource::Fallback as usize] >= rounds
        });
        let _ = peer.stop();
        let report = self.bed.end_controller(controller);
        let record = self.bed.witness().record();
        for action in record.actions.iter().filter(|action| is(ActionSource::Fallback)(action)).take(rounds) {
            let own = record.observations.iter().find(|seen| seen.sequence == action.answers);
            if let Some(own) = own {
                self.fallback_periods.push(self.periods_since(own.published_ns, action));
            }
            self.rounds += 1;
        }
        self.finish(report["counters"].clone())
    }

    fn stalled(mut self, rounds: usize) -> Outcome {
        let stop = AtomicBool::new(false);
        let mut sleeper = Sleeper { period: self.bed.period, left: rounds, ends_ns: Vec::new() };
        let settings = ControllerSettings::new(self.bed.link());
        let peer = self.bed.start_faulty_peer(Fault::None, usize::MAX);
        let report = std::thread::scope(|scope| {
            let (sleeper, stop) = (&mut sleeper, &stop);
            let controller = scope.spawn(move || {
                // Ports stay in the thread that made them.
                let policy = Policy::load(&shipped_bundle(), EngineSettings::tract()).expect("it loads");
                let mut controller = Controller::open(policy, settings).expect("the link can be opened");
                controller.run(stop, &mut [sleeper]).expect("the faults pass");
                let report = controller.report(EngineKind::Tract, Ended::Interrupted);
                controller.close().expect("the link works");
                report
            });
            let fallen = || self.bed.witness().record().actions.len() as u64;
            let enough = (rounds as u64 + 2) * (STALL_EVERY + u64::from(STALL_PERIODS));
            crate::eventually("enough ticks", || fallen() > enough || controller.is_finished());
            stop.store(true, Ordering::Relaxed);
            controller.join().expect("it ends well")
        });
        let _ = peer.stop();
        self.rounds = sleeper.ends_ns.len();
        for end_ns in &sleeper.ends_ns {
            self.back(*end_ns);
        }
        self.finish(serde_json::to_value(report.counters).unwrap_or_default())
    }
}

/// Holds up the loop.
struct Sleeper {
    period: Duration,
    left: usize,
    ends_ns: Vec<u64>,
}

impl TickObserver for Sleeper {
    fn ticked(&mut self, tick: &Tick<'_>) {
        let due = tick.observation.is_some_and(|seen| seen.sequence % STALL_EVERY == STALL_EVERY - 1);
        if due && self.left > 0 {
            std::thread::sleep(self.period * STALL_PERIODS);
            self.left -= 1;
            self.ends_ns.push(monotonic_ns());
        }
    }
}
