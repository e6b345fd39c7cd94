//! The soak tool itself, for some seconds; whoever wants to know about hours runs it for hours.

use rcwm_tests::{Domain, output, read_json};

#[test]
fn a_short_soak_swaps_samples_and_reports_in_tenths() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("soak.json");
    let mut command = Domain::new().command("soak");
    command.args([
        "--minutes",
        "0.2",
        "--swap-every-s",
        "4",
        "--warm-up-swaps",
        "1",
        "--sample-every-s",
        "0.2",
    ]);
    // Memory has not settled yet, and the machine may be busy: what is tested is the tool.
    command.args(["--drift-max-mib", "1000", "--bundle"]).arg(rcwm_tests::shipped_bundle());
    command.arg("--json").arg(&json);
    let output = output(command);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{printed}\n{}", String::from_utf8_lossy(&output.stderr));
    let report = read_json(&json);
    let taken = report["swaps_taken"].as_u64().unwrap();
    assert!(taken >= 2 && report["run"]["counters"]["swaps"] == taken, "{printed}");
    assert_eq!(report["phases"].as_array().unwrap().len(), 10);
    let samples = report["samples"].as_array().unwrap();
    assert!(samples.len() >= 10 && report["drift_mib"].is_number(), "{printed}");
    for sample in samples {
        assert!(
            sample["resident_kib"].as_u64().unwrap() > 1000 && sample["open_files"].as_u64().unwrap() > 3
        );
    }
    assert_eq!(printed.lines().filter(|line| line.starts_with("drift ")).count(), 1, "{printed}");
}
