//! A hostile peer for some thousand messages; `hostile-peer` does as many as are asked for.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rcwm_tests::{Domain, output, read_json, shipped_bundle};

/// Runs `hostile-peer`, which must find nothing, and gives its report.
fn sound(rest: &[&str]) -> serde_json::Value {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("hostile.json");
    let mut command = Domain::new().command("hostile-peer");
    command.args(rest).arg("--bundle").arg(shipped_bundle()).arg("--json").arg(&json);
    let output = output(command);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{printed}\n{}", String::from_utf8_lossy(&output.stderr));
    read_json(&json)
}

#[test]
fn a_hostile_peer_gets_no_action_that_must_not_be_and_is_told_when_the_run_ends() {
    let report = sound(&["--messages", "10000", "--length", "400", "--seed", "1000000"]);
    // The runs are worth something: both paces, every source, swaps, and several ways to end.
    let count = |value: &serde_json::Value| value.as_u64().unwrap_or_else(|| panic!("{report}"));
    assert!(count(&report["messages_in_lockstep"]) > 1000 && count(&report["messages_in_real_time"]) > 1000);
    for source in 0..3 {
        assert!(count(&report["by_source"][source]) > 100, "source {source}: {report}");
    }
    assert!(count(&report["swaps"]) > 0 && count(&report["repeated"]) > 0, "{report}");
    assert!(report["ended"].as_object().is_some_and(|ended| ended.len() >= 2), "{report}");
}

#[test]
fn the_same_seed_makes_the_same_run() {
    sound(&["--messages", "1500", "--length", "300", "--seed", "2000000", "--twice"]);
}
