//! Peers that die without warning, and peers that do not fit.

use std::time::Duration;

use rcwm_tests::faults::{Bed, ControllerOptions, Experiment, Fault, Outcome, poisoned_bundle};
use rcwm_tests::{Domain, Observer, Running, output, read_json, shipped_bundle};
use rustix::process::Signal;

/// Slow enough for a busy machine: these tests tell what is sent, `fault-table` tells when.
const PERIOD: Duration = Duration::from_millis(50);
/// `fault-table` runs fifty.
const ROUNDS: usize = 2;

/// Runs an experiment; nothing stale or invalid was on the wire, and nothing is left.
fn sound(experiment: Experiment, rounds: usize) -> Outcome {
    let outcome = experiment.run(rounds, PERIOD);
    assert!(outcome.verdict.invalid == 0 && outcome.verdict.stale.is_empty(), "{outcome:?}");
    assert_eq!(outcome.leftovers, Vec::<String>::new());
    assert_eq!(outcome.rounds, rounds);
    outcome
}

fn count(outcome: &Outcome, name: &str) -> u64 {
    outcome.counters[name].as_u64().unwrap_or_else(|| panic!("no count {name}: {}", outcome.counters))
}

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
    let simulator = start_simulator(&domain, &[]);
    let mut first = Running::start(runtime(&domain));
    let observer = Observer::new(&domain, "fault");
    observer.wait_for(|observation| observation.sequence >= 3);
    let second = output(runtime(&domain));
    let line = String::from_utf8_lossy(&second.stderr);
    assert!(!second.status.success() && line.contains("another controller"), "{line}");
    let seen = observer.wait_for(|_| true);
    observer.wait_for(|observation| observation.sequence > seen);
    assert!(first.is_running());
    drop(observer);
    for mut running in [first, simulator] {
        running.signal(Signal::INT);
        running.end();
    }
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn a_peer_of_another_version_is_refused_with_one_clear_line() {
    let domain = Domain::new();
    let _old = rcwm_tests::OldPeer::new(&domain, "fault");
    let refused = output(runtime(&domain));
    let line = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success());
    assert!(line.contains("another version") && line.contains("rcwm.Observation.v2"), "{line}");
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

#[test]
fn a_simulator_that_is_killed_is_imagined_then_fallen_back_from_and_the_next_one_is_followed() {
    let outcome = sound(Experiment::SimulatorKilled, ROUNDS);
    assert_eq!(outcome.fallback_periods.len(), ROUNDS);
    let earlier = outcome.stand_in_periods.iter().zip(&outcome.fallback_periods).all(|(a, b)| a < b);
    assert!(earlier, "{outcome:?}");
    assert_eq!(count(&outcome, "peer_restarts"), ROUNDS as u64 - 1);
    assert_eq!(count(&outcome, "imagined_answers"), 5 * ROUNDS as u64);
}

#[test]
fn without_imagining_a_killed_simulator_leads_straight_to_the_fallback() {
    let outcome = sound(Experiment::SimulatorKilledNoImagining, ROUNDS);
    assert_eq!(outcome.stand_in_periods, outcome.fallback_periods);
    assert_eq!(count(&outcome, "imagined_answers"), 0);
}

#[test]
fn a_simulator_that_stands_still_is_followed_again_once_it_moves() {
    let outcome = sound(Experiment::SimulatorStopped, ROUNDS);
    assert_eq!((outcome.back_ms.len(), outcome.fallback_periods.len()), (ROUNDS, ROUNDS));
    assert_eq!(count(&outcome, "peer_restarts"), 0);
}

#[test]
fn a_controller_that_was_killed_or_stood_still_serves_again() {
    assert_eq!(sound(Experiment::ControllerKilled, ROUNDS).back_ms.len(), ROUNDS);
    let outcome = sound(Experiment::ControllerStopped, ROUNDS);
    assert_eq!(outcome.back_ms.len(), ROUNDS);
    assert!(count(&outcome, "missed_observations") >= 5, "{outcome:?}");
}

#[test]
fn observations_that_are_lost_or_come_periods_late_are_imagined() {
    for experiment in [Experiment::Dropped, Experiment::Delayed] {
        let outcome = sound(experiment, 1);
        assert!(count(&outcome, "imagined_answers") >= 1, "{outcome:?}");
    }
}

#[test]
fn observations_that_come_twice_get_the_same_answer_twice() {
    let outcome = sound(Experiment::Doubled, 1);
    assert_eq!(count(&outcome, "repeated_observations"), 1, "{outcome:?}");
}

#[test]
fn a_policy_that_gives_nan_now_and_then_is_replaced_by_the_fallback_just_then() {
    let outcome = sound(Experiment::NotFinite, 5);
    assert!(count(&outcome, "non_finite_outputs") >= 5, "{outcome:?}");
    assert!(outcome.verdict.sources[0] > 0, "the policy answers the rest: {outcome:?}");
}

#[test]
fn a_tick_that_stalls_is_not_followed_by_a_burst() {
    let outcome = sound(Experiment::Stalled, ROUNDS);
    assert_eq!(outcome.back_ms.len(), ROUNDS);
    // Each observation that was looked at has one answer, and those that were slept through have none.
    let answers = count(&outcome, "answers") - count(&outcome, "imagined_answers");
    assert_eq!(
        answers,
        count(&outcome, "observations") - count(&outcome, "overtaken_answers"),
        "{outcome:?}"
    );
    assert!(count(&outcome, "missed_observations") >= ROUNDS as u64, "{outcome:?}");
}

#[test]
fn a_policy_that_is_invalid_for_too_long_ends_the_run_with_its_own_exit_code() {
    let poisoned = poisoned_bundle();
    let bed = Bed::new(PERIOD);
    let bundle = poisoned.path().to_path_buf();
    // Half of all ticks are invalid: the first of them is one too many.
    let mut controller = bed.start_controller(&ControllerOptions {
        bundle,
        fallback_ticks_max: 0,
        ..ControllerOptions::default()
    });
    let peer = bed.start_faulty_peer(Fault::None, usize::MAX);
    assert_eq!(controller.end().code(), Some(4), "{}", controller.printed());
    let printed = controller.printed();
    assert!(printed.contains("error: stopped") && printed.contains("not finite"), "{printed}");
    let _ = peer.stop();
}
