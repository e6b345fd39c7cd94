//! `rcwm-runtime run --record`: the run is logged, and filmed afterwards.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use rcwm_models::programs::Program;
use rcwm_models::wire::{ObservationFlags, SimulatorLink};
use rcwm_runtime::swap::{Answer, When, ask};
use rcwm_testkit::{OwnLink, observation, own_link, smallest_bundle, with_manifest};

/// Five observations of an episode, and their answers.
fn episode(peer: &SimulatorLink, number: u64) {
    for step in 0..5 {
        let mut sent = observation(5 * number + u64::from(step), step);
        sent.episode = number;
        sent.flags |= if step == 4 { ObservationFlags::LAST.0 } else { 0 };
        rcwm_testkit::ask(peer, &sent);
    }
}

fn run(link: &OwnLink) -> Command {
    let mut run = Command::new(Program::RUNTIME.find().unwrap());
    run.env("RCWM_PREFIX", link.prefix()).args(["run", "--instance", &link.0.instance, "--bundle"]);
    run.arg(smallest_bundle()).stdout(Stdio::piped()).stderr(Stdio::piped());
    run
}

#[test]
fn a_run_that_records_takes_swaps_and_is_filmed_with_both_policies() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let peer = link.peer();
    let run = run(&link).arg("--record").arg(folder.path()).args(["--record-episodes", "2"]).spawn().unwrap();
    episode(&peer, 0);
    let other = with_manifest(|manifest| manifest.control.action_low = vec![-0.5; 4]);
    let never = AtomicBool::new(false);
    let answer =
        ask(&link.0, other.path(), When::Now, Some(Duration::from_secs(60)), &never, &mut |_| ()).unwrap();
    assert!(matches!(answer, Answer::Taken { .. }), "{answer:?}");
    (1..4).for_each(|number| episode(&peer, number));
    peer.close().unwrap();
    let output = run.wait_with_output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    let mut names: Vec<_> = folder
        .path()
        .read_dir()
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    // No more than were asked for, in the log either.
    let films =
        ["gif", "npz", "png"].map(|ending| [0, 1].map(|number| format!("episode-000{number}.{ending}")));
    let mut expected: Vec<_> = films.into_iter().flatten().chain(["run.rcwmlog".to_owned()]).collect();
    expected.sort();
    assert_eq!(names, expected);
    assert!(said.contains("10 ticks") && said.matches("recorded ").count() == 4, "{said}");
}

#[test]
fn what_could_not_be_filmed_is_filmed_by_the_command_that_is_told() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let peer = link.peer();
    // It is there when the run begins, and fails after it.
    let run = run(&link).arg("--record").arg(folder.path()).env("RCWM_LAB", "/bin/false").spawn().unwrap();
    episode(&peer, 0);
    peer.close().unwrap();
    let output = run.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8(output.stderr).unwrap();
    let error = said.lines().find(|line| line.starts_with("error: the films")).unwrap();
    let command = error.split('`').nth(1).unwrap().strip_prefix("rcwm-lab ").unwrap();
    let again = Command::new(env!("CARGO_BIN_EXE_rcwm-lab")).args(command.split(' ')).output().unwrap();
    assert!(again.status.success(), "{command}: {}", String::from_utf8_lossy(&again.stderr));
    assert!(folder.path().join("episode-0000.gif").is_file(), "{command}");
}

#[test]
fn without_the_lab_a_run_that_records_does_not_begin() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let mut run = run(&link);
    run.arg("--record").arg(folder.path().join("films")).env("RCWM_LAB", "/no/such/rcwm-lab");
    let output = run.output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said.contains("--record") && said.contains("/no/such/rcwm-lab"), "{said}");
    assert!(!folder.path().join("films").exists());
}
