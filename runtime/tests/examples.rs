//! The examples do what they say.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::process::{Command, Output};

use rcwm_runtime::controller::{Fallback, Pace};
use rcwm_testkit::{own_link, smallest_bundle, start_controller};

/// An example of this package, which `cargo test` builds beside its tests.
fn example(name: &str) -> Command {
    let own = std::env::current_exe().unwrap();
    // target/release/deps/examples-1234 -> target/release/examples/name
    let path = own.parent().unwrap().parent().unwrap().join("examples").join(name);
    assert!(
        path.is_file(),
        "{} is missing: cargo build --release -p rcwm-runtime --examples",
        path.display()
    );
    Command::new(path)
}

fn succeed(command: &mut Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let text = String::from_utf8(stdout).unwrap();
    assert!(status.success(), "{text}{}", String::from_utf8_lossy(&stderr));
    text
}

#[test]
fn the_policy_decides_inside_a_program_of_one_s_own() {
    let text = succeed(example("policy").arg(smallest_bundle()));
    assert_eq!(text.lines().filter(|line| line.starts_with("step ")).count(), 50, "{text}");
}

#[test]
fn a_robot_in_rust_is_driven_over_the_wire_in_lockstep_and_in_real_time() {
    for realtime in [false, true] {
        let link = own_link();
        let controller = start_controller(&smallest_bundle(), &link, Fallback::Hold);
        let mut robot = example("robot");
        robot.env("RCWM_PREFIX", link.prefix());
        robot.args(["--instance", &link.0.instance, "--episodes", "2", "--steps", "15"]);
        robot.args(realtime.then_some("--realtime"));
        let text = succeed(&mut robot);
        let report = controller.join().unwrap();
        let served: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!((&served["episodes"], &served["observations"]), (&2.into(), &32.into()), "{text}");
        assert_eq!((report.whole_episodes, report.counters.refused_observations), (2, 0), "{text}");
        match report.pace {
            Some(Pace::Lockstep) => {
                assert!(!realtime && served["answers"] == 32 && report.counters.missed_observations == 0);
            }
            Some(Pace::Realtime { rate_hz }) => assert!(realtime && (rate_hz - 40.0).abs() < 1e-3),
            None => panic!("nothing was observed"),
        }
    }
}
