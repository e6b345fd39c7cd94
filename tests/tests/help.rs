//! The examples of every `--help` that need nothing but what is shipped run as they stand.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_models::help::examples;
use rcwm_tests::{Domain, output, root};

/// Verbs that ask for no simulator, no run and no minutes; the others are held against the command line in their crates.
const RUNNABLE: [&str; 6] = ["inspect", "verify", "tasks", "parameters", "init", "parity"];

#[test]
fn examples_that_need_only_what_is_shipped_run_as_they_stand() {
    let domain = Domain::new();
    let folder = tempfile::tempdir().unwrap();
    for shipped in ["models", "tests"] {
        std::os::unix::fs::symlink(root().join(shipped), folder.path().join(shipped)).unwrap();
    }
    let mut run = 0;
    for program in ["rcwm-runtime", "rcwm-lab", "rcwm-trainer", "rcwm-simulator"] {
        for verb in RUNNABLE {
            let mut help = domain.command(program);
            let help = help.args([verb, "--help"]).output().unwrap();
            if !help.status.success() {
                continue; // not one of this program's
            }
            for example in examples(&String::from_utf8_lossy(&help.stdout), program) {
                let needs = ["--device", "runs/hammer"].iter().any(|word| example.iter().any(|w| w == word));
                if example[1] != verb || needs {
                    continue;
                }
                let mut command = domain.command(program);
                command.args(&example[1..]).current_dir(folder.path());
                let found = output(command);
                let told = String::from_utf8_lossy(&found.stderr);
                assert!(found.status.success(), "{}: {told}", example.join(" "));
                run += 1;
            }
        }
    }
    assert!(run >= 9, "only {run} examples were found");
}
