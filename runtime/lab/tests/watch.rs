//! `rcwm-lab watch` beside a real controller, whoever comes and goes.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use assert_cmd::cargo::CommandCargoExt;
use rcwm_models::wire::SimulatorLink;
use rcwm_runtime::controller::Fallback;
use rcwm_testkit::{NEVER, OwnLink, ask, observation, own_link, smallest_bundle, start_controller};
use serde_json::Value;

/// A watcher whose lines are read.
struct Watcher {
    child: Child,
    lines: std::io::Lines<BufReader<ChildStdout>>,
}

impl Watcher {
    fn start(link: &OwnLink) -> Self {
        let mut command = Command::cargo_bin("rcwm-lab").unwrap();
        command.args(["watch", "--instance", "test", "--json", "-"]).env("RCWM_PREFIX", link.prefix());
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// Reads lines, after `meanwhile` each, until one fits.
    fn wait_for(&mut self, fits: impl Fn(&Value) -> bool, mut meanwhile: impl FnMut()) -> Value {
        let start = Instant::now();
        while start.elapsed() < NEVER {
            meanwhile();
            let line = serde_json::from_str(&self.lines.next().unwrap().unwrap()).unwrap();
            if fits(&line) {
                return line;
            }
        }
        panic!("no line that fits");
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // It runs on where a test has failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Publishes observations of an episode and waits for their answers, for a second.
fn play(peer: &SimulatorLink, sequence: &mut u64) {
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(1) {
        ask(peer, &observation(*sequence, *sequence as u32));
        *sequence += 1;
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn a_watcher_tells_of_robot_and_controller_whoever_comes_and_goes() {
    let link = own_link();
    let mut watcher = Watcher::start(&link);
    watcher.wait_for(|line| line["robot"].is_null() && line["mode"].is_null(), || ());
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    let (peer, mut sequence) = (link.peer(), 0);
    let seen = |line: &Value| line["answers"].as_u64().unwrap() > 10;
    let line = watcher.wait_for(seen, || play(&peer, &mut sequence));
    assert_eq!((&line["robot"], &line["mode"]), (&"metaworld".into(), &"tracking".into()), "{line}");
    assert!(line["latency_us"]["p50"].as_f64().unwrap() > 0.0, "{line}");
    assert!(line["observations"].as_u64().unwrap() <= sequence && line["rate_hz"].as_f64().unwrap() > 0.0);
    assert_eq!((&line["period_us"], &line["deadlines_missed"]), (&Value::Null, &0.into()), "{line}");
    // Both leave.
    peer.close().unwrap();
    let report = controller.join().unwrap();
    assert_eq!(report.counters.fallback_answers, 0);
    watcher.wait_for(|line| line["robot"].is_null() && line["mode"].is_null(), || ());
    // Others come.
    let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
    let (peer, mut sequence, before) = (link.peer(), 0, line["answers"].as_u64().unwrap());
    let more = |line: &Value| line["robot"] == "metaworld" && line["answers"].as_u64().unwrap() > before + 10;
    watcher.wait_for(more, || play(&peer, &mut sequence));
    peer.close().unwrap();
    controller.join().unwrap();
}

#[test]
fn without_a_terminal_a_line_says_what_there_is_and_the_time_is_kept() {
    let link = own_link();
    let mut command = Command::cargo_bin("rcwm-lab").unwrap();
    command.args(["watch", "--instance", "test", "--seconds", "1.5"]).env("RCWM_PREFIX", link.prefix());
    let told = command.stdin(Stdio::null()).output().unwrap();
    let said = String::from_utf8_lossy(&told.stdout);
    assert!(told.status.success() && said.starts_with("test: waiting for a robot\n"), "{told:?}");
    assert!(!said.contains('\u{1b}'), "nothing that commands a terminal: {said:?}");
}

#[test]
fn an_instance_that_cannot_be_is_named() {
    let mut command = Command::cargo_bin("rcwm-lab").unwrap();
    let told = command.args(["watch", "--instance", "a/b", "--seconds", "1"]).output().unwrap();
    let said = String::from_utf8_lossy(&told.stderr);
    assert!(told.status.code() == Some(1) && said.contains("instance \"a/b\""), "{said}");
}
