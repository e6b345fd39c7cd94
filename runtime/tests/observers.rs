//! What looks on must not hold up the loop: in its thread nothing is allocated, and what waits for the other is bounded.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::sync::mpsc::{Receiver, channel};

use rcwm_models::interface::Camera;
use rcwm_models::wire::{Action, ActionValues, Format, OwnedObservation};
use rcwm_runtime::controller::{Counters, EpisodeResult, Episodes, State, Tick, TickObserver, TickTimes};
use rcwm_runtime::log::{LogSettings, LogWriter};
use rcwm_runtime::policy::{Decision, Sampling};
use rcwm_runtime::record::{Finished, Record, Recorder, Sink};
use rcwm_runtime::telemetry::{Stage, Telemetry};
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::counting::{Counting, allocations};
use rcwm_testkit::{observation, smallest_bundle};

#[global_allocator]
static COUNTING: Counting = Counting;

/// Hands a tick on this observation to a recorder; gives how often it allocated.
fn show(
    recorder: &mut impl TickObserver,
    policy: &Policy,
    telemetry: &Telemetry,
    observation: &OwnedObservation,
    decision: Option<Decision>,
) -> u64 {
    let action = decision.map_or(ActionValues::zeros(4), |decision| decision.action);
    let tick = Tick {
        observation: Some(&observation.view()),
        is_first: observation.step == 0,
        rewound: false,
        decision,
        answer: Action { answers: observation.sequence, published_ns: 3, source: 0, action },
        overtaken: false,
        state: State::default(),
        times: TickTimes { scheduled_ns: 0, published_ns: 1, received_ns: 2, sent_ns: 3 },
        policy,
        telemetry,
        counters: &Counters::default(),
        episodes: &Episodes::default(),
        running: EpisodeResult::start(observation),
    };
    allocations(|| recorder.ticked(&tick)).0
}

#[test]
fn a_record_allocates_nothing_in_the_loop_s_thread() {
    let folder = tempfile::tempdir().unwrap();
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let settings = LogSettings::new("test", EngineSettings::tract(), Sampling::Mode);
    let log = LogWriter::start(&folder.path().join("log"), &policy, settings).unwrap();
    let mut recorder = Recorder::start(&policy, log).unwrap();
    let mut telemetry = Telemetry::new();
    for step in 0..300 {
        let mut observation = observation(u64::from(step), step);
        // Real time: full buffers are no reason to wait.
        observation.period_ns = 1_000_000;
        let executed = (step > 0).then(|| ActionValues::from([0.1; 4]));
        let decision = policy.observe(observation.view().image(0), executed.as_ref()).unwrap();
        Stage::ALL.into_iter().for_each(|stage| telemetry.record(stage, 1000));
        let count = show(&mut recorder, &policy, &telemetry, &observation, Some(decision));
        assert_eq!(count, 0, "step {step}");
    }
    assert_eq!(allocations(|| drop(std::hint::black_box(Box::new(1_u8)))).0, 1, "allocations are counted");
    let Finished { sink, dropped } = recorder.finish().unwrap();
    let summary = sink.finish(dropped).unwrap();
    assert_eq!(summary.ticks + summary.dropped, 300);
}

/// Takes nothing before it may.
struct Waiting {
    begin: Receiver<()>,
    taken: usize,
}

impl Sink for Waiting {
    fn wants_pictures(&self) -> bool {
        true
    }

    fn take(&mut self, _: &Record) {
        let _ = self.begin.recv();
        self.taken += 1;
    }

    fn pause(&mut self, _: u64) {}
}

#[test]
fn few_records_wait_where_the_robot_s_pictures_are_large() {
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let telemetry = Telemetry::new();
    // The policy reads one small camera of a robot that has others: of 3 MiB, and of 48.
    for (side, expected) in [(1024, 10), (4096, 4)] {
        let mut robot = policy.manifest().interface.clone();
        robot.camera.push(Camera { name: "large".into(), shape: [side, side, 3], ..robot.camera[0].clone() });
        robot.camera[1].mask = None;
        let mut large = OwnedObservation::zeroed(&Format::of(robot));
        large.period_ns = 1_000_000;
        let (let_begin, begin) = channel();
        let mut recorder = Recorder::start(&policy, Waiting { begin, taken: 0 }).unwrap();
        for sequence in 0..30 {
            (large.sequence, large.step) = (sequence, sequence as u32);
            show(&mut recorder, &policy, &telemetry, &large, None);
        }
        drop(let_begin);
        let Finished { sink, dropped } = recorder.finish().unwrap();
        assert_eq!((sink.taken, dropped), (expected, 30 - expected as u64), "{side}");
    }
}
