//! What a run tells while it goes on, and leaves behind.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::sync::atomic::AtomicBool;
use std::time::Duration;

use rcwm_runtime::controller::Fallback;
use rcwm_runtime::record::{Finished, Recorder};
use rcwm_runtime::snapshots::{SnapshotSettings, Snapshots};
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::{ask, json_lines, latency_of, observation, own_link, smallest_bundle, start_with};
use serde_json::Value;

#[test]
fn snapshots_add_up_to_the_run() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let file = folder.path().join("run.jsonl");
    let peer = link.peer();
    let every = Duration::from_millis(20);
    let snapshots = Snapshots::start(SnapshotSettings { file: file.clone(), every }).unwrap();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let mut recorder = Recorder::start(&policy, snapshots).unwrap();
    let controller = start_with(policy, &link, Fallback::Hold, move |controller| {
        controller.run(&AtomicBool::new(false), &mut [&mut recorder]).unwrap();
        let Finished { sink, dropped } = recorder.finish().unwrap();
        sink.finish(dropped).unwrap();
    });
    for sequence in 0..40 {
        ask(&peer, &observation(sequence, sequence as u32));
        // Long enough that the run spans several intervals.
        std::thread::sleep(Duration::from_millis(3));
    }
    peer.close().unwrap();
    controller.join().unwrap();
    let lines = json_lines(&file);
    assert!(lines.len() > 2 && lines.iter().rev().skip(1).all(|line| line["last"] == false));
    let last = lines.last().unwrap();
    let sum: u64 = lines.iter().map(|line| line["interval"]["ticks"].as_u64().unwrap()).sum();
    assert_eq!((sum, &last["last"], &last["samples_dropped"]), (40, &true.into(), &0.into()));
    assert_eq!(last["counters"]["observations"], 40);
    for name in ["encoder", "actor", "tick", "end_to_end"] {
        let of = |line: &Value| latency_of(&line["interval"], name)["count"].as_u64().unwrap_or(0);
        assert_eq!(lines.iter().map(of).sum::<u64>(), 40, "{name}");
        assert_eq!(latency_of(&last["total"], name)["count"], 40, "{name}");
    }
    for branch in ["robot_surprise", "environment_surprise"] {
        let found = &last["total"][branch];
        let (p50, max) = (found["p50"].as_f64().unwrap(), found["max"].as_f64().unwrap());
        assert!(0.0 < p50 && p50 <= max, "{branch}: {found}");
    }
}
