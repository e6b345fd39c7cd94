//! What looks on must not hold up the loop: in its thread, nothing is allocated.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_models::wire::{Action, ActionValues};
use rcwm_runtime::controller::{Counters, EpisodeResult, Episodes, State, Tick, TickObserver, TickTimes};
use rcwm_runtime::log::{LogSettings, LogWriter};
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::record::{Finished, Recorder};
use rcwm_runtime::telemetry::{Stage, Telemetry};
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::counting::{Counting, allocations};
use rcwm_testkit::{observation, smallest_bundle};

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn a_record_allocates_nothing_in_the_loop_s_thread() {
    let folder = tempfile::tempdir().unwrap();
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let settings = LogSettings::new("test", EngineSettings::tract(), Sampling::Mode);
    let log = LogWriter::start(&folder.path().join("log"), &policy, settings).unwrap();
    let mut recorder = Recorder::start(&policy, log).unwrap();
    let (mut telemetry, counters) = (Telemetry::new(), Counters::default());
    for step in 0..300 {
        let mut observation = observation(u64::from(step), step);
        // Real time: full buffers are no reason to wait.
        observation.period_ns = 1_000_000;
        let executed = (step > 0).then(|| ActionValues::from([0.1; 4]));
        let decision = policy.observe(observation.view().image(0), executed.as_ref()).unwrap();
        Stage::ALL.into_iter().for_each(|stage| telemetry.record(stage, 1000));
        let answer = Action { answers: u64::from(step), published_ns: 3, source: 0, action: decision.action };
        let tick = Tick {
            observation: Some(&observation.view()),
            is_first: step == 0,
            rewound: false,
            decision: Some(decision),
            answer,
            overtaken: false,
            state: State::default(),
            times: TickTimes { scheduled_ns: 0, published_ns: 1, received_ns: 2, sent_ns: 3 },
            policy: &policy,
            telemetry: &telemetry,
            counters: &counters,
            episodes: &Episodes::default(),
            running: EpisodeResult::start(&observation),
        };
        let (count, ()) = allocations(|| recorder.ticked(&tick));
        assert_eq!(count, 0, "step {step}");
    }
    assert_eq!(allocations(|| drop(std::hint::black_box(Box::new(1_u8)))).0, 1, "allocations are counted");
    let Finished { sink, dropped } = recorder.finish().unwrap();
    let summary = sink.finish(dropped).unwrap();
    assert_eq!(summary.ticks + summary.dropped, 300);
}
