//! What a run tells while it goes on, and leaves behind.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod support;

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use rcwm_runtime::controller::Fallback;
use rcwm_runtime::snapshots::{SnapshotSettings, Snapshots};
use rcwm_runtime::{EngineSettings, Policy};
use serde_json::Value;
use support::{ask, observation, own_link, smallest_bundle, start_with};

fn lines(file: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(file).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn stage<'a>(summary: &'a Value, name: &str) -> &'a Value {
    let stages = summary["latency"].as_array().unwrap();
    stages.iter().find(|latency| latency["stage"] == name).unwrap_or(&Value::Null)
}

#[test]
fn snapshots_add_up_to_the_run() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let file = folder.path().join("run.jsonl");
    let peer = link.peer();
    let every = Duration::from_millis(20);
    let mut snapshots = Snapshots::start(SnapshotSettings { file: file.clone(), every }).unwrap();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let controller = start_with(policy, &link, Fallback::Hold, move |controller| {
        controller.run(&AtomicBool::new(false), &mut [&mut snapshots]).unwrap();
        snapshots.finish().unwrap();
    });
    for sequence in 0..40 {
        ask(&peer, &observation(sequence, sequence as u32));
        // Long enough that the run spans several intervals.
        std::thread::sleep(Duration::from_millis(3));
    }
    peer.close().unwrap();
    controller.join().unwrap();
    let lines = lines(&file);
    assert!(lines.len() > 2 && lines.iter().rev().skip(1).all(|line| line["last"] == false));
    let last = lines.last().unwrap();
    let sum: u64 = lines.iter().map(|line| line["interval"]["ticks"].as_u64().unwrap()).sum();
    assert_eq!((sum, &last["last"], &last["samples_dropped"]), (40, &true.into(), &0.into()));
    assert_eq!(last["counters"]["observations"], 40);
    for name in ["encoder", "actor", "tick", "end_to_end"] {
        let of = |line: &Value| stage(&line["interval"], name)["count"].as_u64().unwrap_or(0);
        assert_eq!(lines.iter().map(of).sum::<u64>(), 40, "{name}");
        assert_eq!(stage(&last["total"], name)["count"], 40, "{name}");
    }
    for branch in ["robot_surprise", "environment_surprise"] {
        let found = &last["total"][branch];
        let (p50, max) = (found["p50"].as_f64().unwrap(), found["max"].as_f64().unwrap());
        assert!(0.0 < p50 && p50 <= max, "{branch}: {found}");
    }
}

#[test]
fn a_run_leaves_a_log_percentile_files_and_a_plot() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let at = |name: &str| folder.path().join(name);
    let peer = link.peer();
    let mut run = Command::new(env!("CARGO_BIN_EXE_rcwm-runtime"));
    run.env("RCWM_PREFIX", link.prefix()).stdout(Stdio::null()).stderr(Stdio::null());
    run.args(["run", "--instance", &link.0.instance, "--telemetry-every", "50ms", "--bundle"])
        .arg(smallest_bundle());
    for (option, name) in
        [("--log", "log"), ("--telemetry", "jsonl"), ("--hgrm", "hgrm"), ("--plot", "run.png")]
    {
        run.arg(option).arg(at(name));
    }
    let mut run = run.spawn().unwrap();
    for sequence in 0..20 {
        ask(&peer, &observation(sequence, sequence as u32));
    }
    peer.close().unwrap();
    assert!(run.wait().unwrap().success());
    assert_eq!(lines(&at("jsonl")).last().unwrap()["total"]["ticks"], 20);
    let mut telemetry = Command::new(env!("CARGO_BIN_EXE_rcwm-runtime"));
    telemetry.args(["telemetry", "--log"]).arg(at("log")).arg("--hgrm").arg(at("again"));
    telemetry.arg("--plot").arg(at("again.png")).arg("--json").arg(at("again.json"));
    assert!(telemetry.output().unwrap().status.success());
    let report: Value = serde_json::from_slice(&std::fs::read(at("again.json")).unwrap()).unwrap();
    assert_eq!((&report["ticks"], &stage(&report, "tick")["count"]), (&20.into(), &20.into()));
    for name in ["tick.hgrm", "encoder.hgrm", "end_to_end.hgrm"] {
        let texts = ["hgrm", "again"].map(|folder| std::fs::read_to_string(at(folder).join(name)).unwrap());
        assert_eq!(texts[0], texts[1], "the log holds the times that the run measured");
    }
    for name in ["run.png", "again.png"] {
        assert!(image::open(at(name)).is_ok());
    }
}
