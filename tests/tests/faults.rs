//! Peers that die without warning, and peers that do not fit.

use rcwm_tests::{Domain, Observer, Running, output, read_json, shipped_bundle};

fn start_simulator(domain: &Domain, rest: &[&str]) -> Running {
    let mut command = domain.command("rcwm-simulator");
    command.args(["serve", "--task", "reach", "--instance", "fault", "--episodes", "0"]).args(rest);
    Running::start(command)
}

fn runtime(domain: &Domain) -> std::process::Command {
    let mut command = domain.command("rcwm-runtime");
    command.args(["run", "--instance", "fault", "--bundle"]).arg(shipped_bundle());
    command
}

#[test]
fn the_simulator_goes_on_after_each_of_fifty_killed_controllers() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("simulator.json");
    let domain = Domain::new();
    let mut simulator = start_simulator(&domain, &["--json", json.to_str().unwrap(), "--steps-max", "60"]);
    let observer = Observer::new(&domain, "fault");
    let mut sequence = 0;
    for round in 0..50 {
        let mut controller = Running::start(runtime(&domain));
        // Progress under this controller, and then death in the middle of an episode.
        let seen = observer.wait_for(|observation| {
            observation.sequence >= sequence + 3 && (2..55).contains(&observation.step)
        });
        assert!(controller.is_running(), "round {round}: {}", controller.printed());
        controller.kill();
        sequence = seen;
        assert!(simulator.is_running(), "round {round}: {}", simulator.printed());
    }
    simulator.signal(rustix::process::Signal::INT);
    simulator.succeed();
    let report = read_json(&json);
    assert!(report["controllers_came"].as_u64().unwrap() >= 50, "{report}");
    assert_eq!(report["actions_refused"], 0);
    drop(observer);
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn the_controller_goes_on_with_the_next_simulator() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("runtime.json");
    let domain = Domain::new();
    let first = start_simulator(&domain, &[]);
    let mut command = runtime(&domain);
    command.arg("--json").arg(&json);
    let mut controller = Running::start(command);
    let observer = Observer::new(&domain, "fault");
    observer.wait_for(|observation| observation.step >= 5);
    first.kill();
    assert!(controller.is_running(), "{}", controller.printed());
    let mut command = domain.command("rcwm-simulator");
    command.args(["serve", "--task", "reach", "--instance", "fault", "--episodes", "1", "--steps-max", "10"]);
    let mut second = Running::start(command);
    second.succeed();
    controller.succeed();
    let report = read_json(&json);
    assert_eq!(report["counters"]["peer_restarts"], 1, "{report}");
    assert_eq!(report["whole_episodes"], 1);
    drop(observer);
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn a_second_controller_is_refused_and_the_first_goes_on() {
    let domain = Domain::new();
    let _simulator = start_simulator(&domain, &[]);
    let mut first = Running::start(runtime(&domain));
    let observer = Observer::new(&domain, "fault");
    observer.wait_for(|observation| observation.sequence >= 3);
    let second = output(runtime(&domain));
    let line = String::from_utf8_lossy(&second.stderr);
    assert!(!second.status.success() && line.contains("another controller"), "{line}");
    let seen = observer.wait_for(|_| true);
    observer.wait_for(|observation| observation.sequence > seen);
    assert!(first.is_running());
}

#[test]
fn a_peer_of_another_version_is_refused_with_one_clear_line() {
    let domain = Domain::new();
    let _old = rcwm_tests::OldPeer::new(&domain, "fault");
    let refused = output(runtime(&domain));
    let line = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success());
    assert!(line.contains("another version") && line.contains("rcwm.Observation.v1"), "{line}");
    let mut command = domain.command("rcwm-simulator");
    command.args(["serve", "--task", "reach", "--instance", "fault", "--episodes", "1"]);
    let refused = output(command);
    let line = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && line.contains("another version"), "{line}");
}

#[test]
fn an_unknown_task_names_the_near_ones() {
    let domain = Domain::new();
    let mut command = domain.command("rcwm-simulator");
    command.args(["serve", "--task", "hamer", "--instance", "fault"]);
    let refused = output(command);
    let line = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && line.contains("hammer"), "{line}");
    assert_eq!(line.trim().lines().count(), 1, "{line}");
}
