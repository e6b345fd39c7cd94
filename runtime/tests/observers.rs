//! What looks on must not hold up the loop: in its thread, nothing is allocated.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::time::Duration;

use rcwm_models::wire::Action;
use rcwm_runtime::controller::{Counters, EpisodeResult, State, Tick, TickObserver, TickTimes};
use rcwm_runtime::log::{LogSettings, Logger};
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::telemetry::{SnapshotSettings, Snapshots, Stage, Telemetry};
use rcwm_runtime::{EngineSettings, Policy};
use support::{observation, smallest_bundle};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// Counts the allocations of each thread.
struct Counting;

// SAFETY: every call is passed on to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn logging_and_snapshots_allocate_nothing_in_the_loop_s_thread() {
    let folder = tempfile::tempdir().unwrap();
    let mut policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let settings = LogSettings::new("test", EngineSettings::tract(), Sampling::Mode);
    let mut logger = Logger::start(&folder.path().join("log"), &policy, settings).unwrap();
    let file = folder.path().join("snapshots.jsonl");
    let mut snapshots = Snapshots::start(SnapshotSettings { file, every: Duration::from_secs(1) }).unwrap();
    let (mut telemetry, counters) = (Telemetry::new(), Counters::default());
    for step in 0..300 {
        let mut observation = observation(u64::from(step), step);
        // Real time: full buffers are no reason to wait.
        observation.period_ns = 1_000_000;
        let executed = (step > 0).then_some(&[0.1; 4]);
        let decision = policy.observe(&observation.image, executed).unwrap();
        Stage::ALL.into_iter().for_each(|stage| telemetry.record(stage, 1000));
        let answer = Action {
            answers: u64::from(step),
            published_ns: 3,
            source: 0,
            reserved: 0,
            action: decision.action,
        };
        let tick = Tick {
            observation: Some(&observation),
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
            episodes: &[],
            running: EpisodeResult::start(&observation),
        };
        let before = ALLOCATIONS.get();
        logger.ticked(&tick);
        snapshots.ticked(&tick);
        assert_eq!(ALLOCATIONS.get(), before, "step {step}");
    }
    assert!(ALLOCATIONS.get() > 1000, "allocations are counted");
    let summary = logger.finish().unwrap();
    snapshots.finish().unwrap();
    assert_eq!(summary.ticks + summary.dropped, 300);
}
