//! The program as people run it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::io::{BufRead, BufReader};
use std::process::{Command, Output, Stdio};

use rustix::process::{Pid, Signal, kill_process};

fn simulator() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rcwm-simulator"));
    command.env("RCWM_PREFIX", format!("cli{}", std::process::id()));
    command
}

fn failure(output: &Output) -> String {
    assert!(!output.status.success());
    let text = String::from_utf8(output.stderr.clone()).unwrap();
    assert_eq!(text.trim_end().lines().count(), 1, "one line says what is wrong: {text}");
    text
}

#[test]
fn an_unknown_task_ends_with_one_line_that_names_the_near_ones() {
    let output = simulator().args(["serve", "--task", "dor-open"]).output().unwrap();
    assert!(failure(&output).contains("near names: door-open"));
}

#[test]
fn a_free_run_without_anybody_to_decide_is_refused() {
    let output = simulator().args(["serve", "--task", "reach", "--free-run"]).output().unwrap();
    assert!(failure(&output).contains("--policy expert"));
}

#[test]
fn all_tasks_are_listed_with_their_role() {
    let output = simulator().args(["tasks", "--json", "-"]).output().unwrap();
    let tasks: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(tasks.len(), 50);
    let count = |role: &str| tasks.iter().filter(|task| task["role"] == role).count();
    assert_eq!((count("upstream"), count("downstream")), (4, 8));
}

#[test]
fn a_virtual_environment_without_the_packages_ends_with_the_line_that_installs_them() {
    let folder = tempfile::tempdir().unwrap();
    let venv = folder.path().join("empty");
    let made = Command::new(env!("RCWM_PYTHON_EXECUTABLE"))
        .args(["-m", "venv", "--without-pip"])
        .arg(&venv)
        .status()
        .unwrap();
    assert!(made.success());
    let output = simulator()
        .args(["serve", "--task", "reach", "--instance", "empty", "--free-run", "--policy", "random"])
        .env("RCWM_PYTHON_VENV", &venv)
        .output()
        .unwrap();
    let text = failure(&output);
    assert!(
        text.contains("numpy") && text.contains("scripts/setup demo") && text.contains("requirements.txt"),
        "{text}"
    );
}

#[test]
fn a_free_run_writes_pictures_and_a_summary_for_machines() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("report.json");
    let output = simulator()
        .args(["serve", "--task", "reach", "--instance", "free", "--policy", "mixed", "--free-run"])
        .args(["--episodes", "2", "--steps-max", "3", "--masks", "--snapshot"])
        .arg(folder.path())
        .arg("--json")
        .arg(&json)
        // Whatever the caller's Python variables say, the packages are found.
        .env("PYTHONHOME", "/nowhere")
        .env("PYTHONPATH", "/nowhere")
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
    assert_eq!((report["episodes"].as_u64(), report["steps"].as_u64()), (Some(2), Some(6)));
    let picture = image::open(folder.path().join("reach-e0000-s000.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (130 * 6, 64 * 6));
}

#[test]
fn ctrl_c_ends_a_run_without_an_end_with_its_summary() {
    let mut running = simulator()
        .args(["serve", "--task", "reach", "--instance", "endless", "--policy", "random", "--free-run"])
        .args(["--json", "-"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(running.stderr.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.contains("Ctrl-C ends"), "{line}");
    kill_process(Pid::from_child(&running), Signal::INT).unwrap();
    let output = running.wait_with_output().unwrap();
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("episodes") && text.contains("\"steps_per_s\""), "{text}");
}
