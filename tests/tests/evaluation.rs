//! The trainer judges a policy in closed loop, through the exported bundle, real simulators and real runtimes.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::process::Command;

use rcwm_tests::{Domain, Running, binary, eventually, output, read_json};
use rustix::process::Signal;

/// An untrained checkpoint.
fn checkpoint(domain: &Domain, folder: &Path, model: &str) -> std::path::PathBuf {
    let place = folder.join(model);
    let mut command = domain.command("rcwm-trainer");
    command.args(["init", "--preset", "debug", "--model", model, "--out"]).arg(&place);
    Running::start(command).succeed();
    place
}

fn evaluate(domain: &Domain, checkpoint: &Path, rest: &[&str]) -> Command {
    let mut command = domain.command("rcwm-trainer");
    command.arg("evaluate").arg("--checkpoint").arg(checkpoint).args(["--task", "reach"]).args(rest);
    command
}

/// Files left in the shared memory that this evaluation had for itself.
fn leftovers(trainer: &Running) -> Vec<String> {
    rcwm_models::wire::list_leftovers(&format!("rcwm_e{}_", trainer.id())).unwrap()
}

/// Processes other than this one whose command line names the folder.
fn processes_with(folder: &Path) -> usize {
    let name = folder.to_string_lossy().into_owned();
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let lines = entries.filter_map(|entry| std::fs::read(entry.path().join("cmdline")).ok());
    lines.filter(|line| String::from_utf8_lossy(line).contains(&name)).count()
}

#[test]
fn a_policy_is_judged_by_whole_episodes_and_nothing_is_left_behind() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let checkpoint = checkpoint(&domain, folder.path(), "rcwm");
    let json = |name: &str| folder.path().join(name);
    let measured = |file: &Path, simulators: &str| {
        let rest = ["--episodes", "3", "--steps-max", "8", "--seed", "5", "--simulators", simulators];
        let mut command = evaluate(&domain, &checkpoint, &rest);
        command.arg("--json").arg(file);
        let mut trainer = Running::start(command);
        trainer.succeed();
        assert_eq!(leftovers(&trainer), Vec::<String>::new());
        read_json(file)["tasks"][0].clone()
    };
    let (one, two) = (measured(&json("one.json"), "1"), measured(&json("two.json"), "2"));
    for report in [&one, &two] {
        assert_eq!((report["episodes"].as_u64(), report["steps"].as_u64()), (Some(3), Some(24)), "{report}");
        let (low, high) = (&report["interval"]["low"], &report["interval"]["high"]);
        assert!(low.as_f64() < high.as_f64() && report["success_rate"].as_f64().is_some());
        for runtime in report["runtimes"].as_array().unwrap() {
            assert_eq!(runtime["counters"]["fallback_answers"], 0, "the policy itself was judged");
        }
    }
    assert_eq!(one["returns"], two["returns"], "layouts do not depend on how many simulators there are");
    assert_eq!(two["runtimes"].as_array().unwrap().len(), 2);
}

#[test]
fn ctrl_c_ends_simulators_and_runtimes_too() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let checkpoint = checkpoint(&domain, folder.path(), "rcwm");
    let scratch = folder.path().join("scratch");
    std::fs::create_dir(&scratch).unwrap();
    let mut command = evaluate(&domain, &checkpoint, &["--episodes", "1000"]);
    command.env("TMPDIR", &scratch);
    let mut trainer = Running::start(command);
    eventually("simulator and runtime were started", || processes_with(&scratch) == 2);
    trainer.signal(Signal::INT);
    assert!(!trainer.end().success());
    assert!(trainer.printed().contains("interrupted"), "{}", trainer.printed());
    assert_eq!(processes_with(&scratch), 0);
    assert_eq!(leftovers(&trainer), Vec::<String>::new());
    assert_eq!(std::fs::read_dir(&scratch).unwrap().count(), 0, "the temporary bundle is gone");
}

#[test]
fn what_cannot_be_judged_is_one_clear_error() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let vanilla = checkpoint(&domain, folder.path(), "vanilla");
    let failed = |command| {
        let output = output(command);
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let text = failed(evaluate(&domain, &vanilla, &[]));
    assert!(text.contains("vanilla") && text.lines().count() == 1, "{text}");
    let rcwm = checkpoint(&domain, folder.path(), "rcwm");
    let text = failed(evaluate(&domain, &rcwm, &["--simulator", "/no/such/program"]));
    assert!(text.contains("/no/such/program") && text.lines().count() == 1, "{text}");
    let broken = binary("rcwm-trainer").display().to_string();
    let text = failed(evaluate(&domain, &rcwm, &["--simulator", &broken]));
    assert!(text.contains("rcwm-simulator") && text.contains("ended early"), "{text}");
}
