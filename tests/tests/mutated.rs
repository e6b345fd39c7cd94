//! Some hundreds of damaged bundles; `mutated-bundles` does as many as are asked for.

use rcwm_tests::{Domain, output, read_json, shipped_bundle};

#[test]
fn no_damaged_bundle_makes_the_runtime_panic_hang_or_ask_for_much_memory() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("mutated.json");
    let mut command = Domain::new().command("mutated-bundles");
    // Generous in time: how fast it is depends on what else this machine does.
    command.args([
        "--count",
        "400",
        "--seed",
        "1000000",
        "--cpu-s-max",
        "20",
        "--wall-s-max",
        "110",
        "--bundle",
    ]);
    command.arg(shipped_bundle()).arg("--json").arg(&json);
    let output = output(command);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{printed}\n{}", String::from_utf8_lossy(&output.stderr));
    let report = read_json(&json);
    assert_eq!(report["cases"], 400);
    assert_eq!(report["caught_panics"], 0, "{printed}");
    // The cases are worth something: some are stopped at the door, some come as far as the golden values.
    for step in ["open", "verify", "accepted"] {
        assert!(report["ended"][step].as_u64().is_some_and(|count| count > 0), "{step}: {printed}");
    }
}
