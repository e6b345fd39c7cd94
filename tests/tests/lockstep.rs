//! The loop between the real simulator and the real runtime: nothing is lost, nothing is answered twice.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::process::Command;

use rcwm_tests::{Domain, Running, read_json, shipped_bundle};
use rustix::process::Signal;

fn simulator(domain: &Domain, instance: &str, task: &str, json: &Path, rest: &[&str]) -> Command {
    let mut command = domain.command("rcwm-simulator");
    command
        .args(["serve", "--task", task, "--instance", instance, "--seed", "3", "--json"])
        .arg(json)
        .args(rest);
    command
}

fn runtime(domain: &Domain, instance: &str, json: &Path) -> Command {
    let mut command = domain.command("rcwm-runtime");
    command.args(["run", "--instance", instance, "--bundle"]).arg(shipped_bundle()).arg("--json").arg(json);
    command
}

/// Everything the simulator published was answered, once, and nothing else was.
fn assert_exact(simulator: &serde_json::Value, runtime: &serde_json::Value, observations: u64) {
    let counters = &runtime["counters"];
    let count =
        |name: &str| counters[name].as_u64().unwrap_or_else(|| panic!("no counter {name}: {counters}"));
    assert_eq!(simulator["observations"], observations, "{simulator}");
    assert_eq!(count("observations") - count("repeated_observations"), observations, "{counters}");
    assert_eq!(count("answers"), count("observations"), "{counters}");
    for never in [
        "stale_observations",
        "missed_observations",
        "refused_observations",
        "non_finite_outputs",
        "engine_errors",
        "fallback_answers",
    ] {
        assert_eq!(count(never), 0, "{never}");
    }
    assert_eq!(simulator["actions_held"], 0);
    assert_eq!(simulator["actions_refused"], 0);
    let sum = |value: &serde_json::Value| -> f64 {
        value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).sum()
    };
    let seen: f64 =
        runtime["episodes"].as_array().unwrap().iter().map(|e| e["return"].as_f64().unwrap()).sum();
    assert!((sum(&simulator["returns"]) - seen).abs() < 1e-3, "both sides saw the same rewards");
}

#[test]
fn every_observation_is_answered_exactly_once() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (left, right) = (folder.path().join("simulator.json"), folder.path().join("runtime.json"));
    let mut simulator = Running::start(simulator(
        &domain,
        "exact",
        "reach",
        &left,
        &["--episodes", "2", "--steps-max", "30"],
    ));
    let mut runtime = Running::start(runtime(&domain, "exact", &right));
    simulator.succeed();
    runtime.succeed();
    assert_exact(&read_json(&left), &read_json(&right), 2 * 31);
    assert_eq!(read_json(&right)["whole_episodes"], 2);
    assert_eq!(read_json(&right)["ended"], "simulator_closed");
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn two_instances_run_side_by_side() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let tasks = ["button-press", "window-open"];
    let file = |task: &str, side: &str| folder.path().join(format!("{task}-{side}.json"));
    let rest = ["--episodes", "1", "--steps-max", "20"];
    let mut running: Vec<Running> = Vec::new();
    for task in tasks {
        running.push(Running::start(simulator(&domain, task, task, &file(task, "simulator"), &rest)));
        running.push(Running::start(runtime(&domain, task, &file(task, "runtime"))));
    }
    running.iter_mut().for_each(Running::succeed);
    for task in tasks {
        let report = read_json(&file(task, "runtime"));
        assert_exact(&read_json(&file(task, "simulator")), &report, 21);
        assert_eq!(report["episodes"][0]["task"], task, "each runtime saw its own simulator");
    }
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn in_real_time_the_simulator_never_waits_and_both_sides_agree() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (left, right) = (folder.path().join("simulator.json"), folder.path().join("runtime.json"));
    let rest = ["--episodes", "1", "--steps-max", "40", "--pace", "realtime", "--rate-hz", "20"];
    let mut simulator = Running::start(simulator(&domain, "clock", "reach", &left, &rest));
    let mut runtime = Running::start(runtime(&domain, "clock", &right));
    simulator.succeed();
    runtime.succeed();
    let (left, right) = (read_json(&left), read_json(&right));
    assert_eq!(left["observations"], 41);
    assert_eq!(right["pace"]["mode"], "realtime");
    let counters = &right["counters"];
    let count = |name: &str| counters[name].as_u64().unwrap();
    // The controller may come late and miss some; what it saw and what it knows that it missed is all there was since.
    assert!(count("observations") + count("missed_observations") <= 41 + count("repeated_observations"));
    // On a busy machine some ticks are imagined, or their answers overtaken.
    assert!(
        count("answers") <= count("observations") + count("imagined_answers") + count("fallback_answers")
    );
    let unanswered = count("stale_observations") + count("overtaken_answers");
    assert!(count("answers") + unanswered >= count("observations"));
}

#[test]
fn ctrl_c_ends_either_side_cleanly() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (left, right) = (folder.path().join("simulator.json"), folder.path().join("runtime.json"));
    let mut simulator = Running::start(simulator(&domain, "stop", "reach", &left, &["--episodes", "0"]));
    let mut runtime = Running::start(runtime(&domain, "stop", &right));
    let observer = rcwm_tests::Observer::new(&domain, "stop");
    observer.wait_for(|observation| observation.sequence >= 20);
    runtime.signal(Signal::INT);
    runtime.succeed();
    assert_eq!(read_json(&right)["ended"], "interrupted");
    assert!(runtime.printed().contains("episodes"), "the summary is printed: {}", runtime.printed());
    assert!(simulator.is_running(), "the simulator waits for the next controller");
    simulator.signal(Signal::INT);
    simulator.succeed();
    assert!(read_json(&left)["steps"].as_u64().unwrap() >= 20);
    drop(observer);
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}
