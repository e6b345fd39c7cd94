//! What a run leaves behind for the lab.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::process::{Command, Stdio};

use rcwm_models::programs::Program;
use rcwm_testkit::{ask, json_lines, latency_of, observation, own_link, smallest_bundle};
use serde_json::Value;

#[test]
fn a_run_leaves_a_log_percentile_files_and_a_plot() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let at = |name: &str| folder.path().join(name);
    let peer = link.peer();
    let mut run = Command::new(Program::RUNTIME.find().unwrap());
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
    assert_eq!(json_lines(&at("jsonl")).last().unwrap()["total"]["ticks"], 20);
    let mut telemetry = Command::new(env!("CARGO_BIN_EXE_rcwm-lab"));
    telemetry.args(["telemetry", "--log"]).arg(at("log")).arg("--hgrm").arg(at("again"));
    telemetry.arg("--plot").arg(at("again.png")).arg("--json").arg(at("again.json"));
    assert!(telemetry.output().unwrap().status.success());
    let report: Value = serde_json::from_slice(&std::fs::read(at("again.json")).unwrap()).unwrap();
    assert_eq!((&report["ticks"], &latency_of(&report, "tick")["count"]), (&20.into(), &20.into()));
    for name in ["tick.hgrm", "encoder.hgrm", "end_to_end.hgrm"] {
        let texts = ["hgrm", "again"].map(|folder| std::fs::read_to_string(at(folder).join(name)).unwrap());
        assert_eq!(texts[0], texts[1], "the log holds the times that the run measured");
    }
    for name in ["run.png", "again.png"] {
        assert!(image::open(at(name)).is_ok());
    }
}
