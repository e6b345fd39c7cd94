//! A run of the real simulator is exported as MCAP, and read by the readers of others.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rcwm_models::wire::OwnedObservation;
use rcwm_runtime::log::{Entry, LogReader};
use rcwm_tests::{Domain, Running, output, root, shipped_bundle};
use serde_json::{Value, json};

/// How many observations and answers a log holds, and the last observation and answer.
fn read_log(log: &mut LogReader) -> (usize, usize, OwnedObservation, Vec<f32>) {
    let (mut observations, mut answers, mut last, mut sent) = (0, 0, None, Vec::new());
    while let Some(entry) = log.read().unwrap() {
        let Entry::Tick(tick) = entry else { panic!("no policy took over") };
        if tick.observation.is_some() {
            (observations, last) = (observations + 1, tick.observation);
        }
        if !tick.record.overtaken {
            (answers, sent) = (answers + 1, tick.record.answer.action.to_vec());
        }
    }
    (observations, answers, last.unwrap(), sent)
}

#[test]
fn a_run_that_is_exported_is_read_by_others_as_it_was_logged() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let at = |name: &str| folder.path().join(name);
    let mut simulator = domain.command("rcwm-simulator");
    simulator.args(["serve", "--task", "reach", "--instance", "mcap", "--episodes", "2"]);
    simulator.args(["--steps-max", "10", "--masks"]);
    let mut simulator = Running::start(simulator);
    let mut run = domain.command("rcwm-runtime");
    run.args(["run", "--instance", "mcap", "--bundle"]).arg(shipped_bundle());
    run.arg("--log").arg(at("run.rcwmlog"));
    let mut run = Running::start(run);
    simulator.succeed();
    run.succeed();
    let mut export = domain.command("rcwm-lab");
    export.args(["export-mcap", "--log"]).arg(at("run.rcwmlog")).arg("--out").arg(at("run.mcap"));
    Running::start(export).succeed();

    let mut reader = domain.python(&root().join("tests/python/read_mcap.py"));
    reader.arg(at("run.mcap"));
    reader.args(["/rcwm/camera/image", "/rcwm/state/arm_vel", "/rcwm/action/hand"]);
    let told = output(reader);
    assert!(told.status.success(), "{}", String::from_utf8_lossy(&told.stderr));
    let told: Value = serde_json::from_slice(&told.stdout).unwrap();

    let mut log = LogReader::open(&at("run.rcwmlog")).unwrap();
    let to_unix_ns = log.header().monotonic_to_unix_ns.unwrap();
    let (observations, answers, last, sent) = read_log(&mut log);
    assert_eq!(observations, 22);
    let counts = &told["counts"];
    for topic in ["camera/image", "mask/image", "state/joint_pos", "executed/hand", "reward", "flags"] {
        assert_eq!(counts[format!("/rcwm/{topic}")], observations, "{topic}: {counts}");
    }
    for topic in ["action/hand", "mode", "surprise/environment", "latency_us/tick"] {
        assert_eq!(counts[format!("/rcwm/{topic}")], answers, "{topic}: {counts}");
    }
    let all: u64 = counts.as_object().unwrap().values().map(|count| count.as_u64().unwrap()).sum();
    assert_eq!((&told["profile"], &told["indexed"]), (&"ros2".into(), &all.into()));
    let unix = |ns: u64| ns as i64 + to_unix_ns;
    let taken_ns = if last.captured_ns[0] > 0 { last.captured_ns[0] } else { last.published_ns };
    assert_eq!(
        told["image"],
        json!({
            "stamp_ns": unix(taken_ns), "frame": "image", "size": [64, 64, 192], "encoding": "rgb8",
            "data": last.view().image(0),
        })
    );
    let range = last.view().format().interface().state_range("arm_vel").unwrap();
    let velocity: Vec<_> = last.view().state()[range].iter().map(|x| f64::from(*x)).collect();
    let names: Vec<_> = (0..7).map(|joint| format!("right_j{joint}")).collect();
    assert_eq!(
        told["joints"],
        json!({
            "stamp_ns": unix(last.published_ns), "name": names, "position": [], "velocity": velocity, "effort": [],
        })
    );
    let sent: Vec<_> = sent.iter().map(|x| f64::from(*x)).collect();
    assert_eq!(
        (&told["numbers"]["data"], &told["numbers"]["label"]),
        (&json!(sent), &"x,y,z,gripper".into())
    );
    assert_eq!(told["types"]["/rcwm/state/joint_pos"], "std_msgs/msg/Float64MultiArray", "in no unit of ROS");
}
