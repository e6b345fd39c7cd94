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
fn the_trainer_decides_what_the_runtime_decides() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let judged = |model: &str, engine: &str| {
        let checkpoint = checkpoint(&domain, &folder.path().join(engine), model);
        let rest =
            ["--episodes", "3", "--steps-max", "8", "--seed", "5", "--simulators", "2", "--engine", engine];
        let mut command = evaluate(&domain, &checkpoint, &rest);
        let file = folder.path().join(format!("{model}-{engine}.json"));
        command.arg("--json").arg(&file);
        Running::start(command).succeed();
        read_json(&file)["tasks"][0].clone()
    };
    let returns = |report: &serde_json::Value| -> Vec<f64> {
        report["returns"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
    };
    for model in ["rcwm", "vanilla"] {
        let (runtime, trainer) = (judged(model, "tract"), judged(model, "trainer"));
        let engines = (&runtime["settings"]["engine"], &trainer["settings"]["engine"]);
        assert_eq!(engines, (&"tract".into(), &"trainer".into()));
        assert_eq!((trainer["episodes"].as_u64(), trainer["steps"].as_u64()), (Some(3), Some(24)));
        for (a, b) in returns(&runtime).into_iter().zip(returns(&trainer)) {
            assert!(
                (a - b).abs() < 1e-3 * a.abs().max(1.0),
                "{model}: return {a} by the runtime, {b} by the trainer"
            );
        }
    }
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

/// A command that has ended well, and what it printed.
fn done(command: Command) -> String {
    let mut running = Running::start(command);
    running.succeed();
    running.printed()
}

/// An untrained bundle in a folder named after its task, and two recorded episodes with masks.
fn inputs(domain: &Domain, folder: &Path, checkpoint: &Path) {
    let mut export = domain.command("rcwm-trainer");
    export.args(["export", "--task", "reach", "--golden-ticks", "1", "--checkpoint"]).arg(checkpoint);
    export.arg("--out").arg(folder.join("bundles/reach"));
    done(export);
    let mut collect = domain.command("rcwm-trainer");
    collect.args(["collect", "--task", "reach", "--expert", "2", "--masks", "2", "--steps-max", "16"]);
    collect.args(["--simulators", "1", "--out"]).arg(folder.join("data"));
    done(collect);
}

#[test]
fn a_report_is_one_page_that_needs_nothing_else_and_measures_nothing_twice() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let models = ["rcwm", "vanilla"].map(|model| checkpoint(&domain, folder.path(), model));
    inputs(&domain, folder.path(), &models[0]);
    let place = folder.path().join("report");
    let report = |inputs: bool| {
        let mut command = domain.command("rcwm-trainer");
        command.arg("evaluate").arg("--report").arg(&place);
        if inputs {
            for model in &models {
                command.arg("--checkpoint").arg(model);
            }
            command.arg("--data").arg(folder.path().join("data"));
            command.arg("--bundles").arg(folder.path().join("bundles"));
            command.args(["--trajectories", "2", "--context", "3", "--imagined", "5"]);
            command.args(["--episodes", "2", "--steps-max", "8", "--disturb", "noise"]);
        }
        done(command)
    };
    // Two models, one attention, a policy with and without disturbance.
    let printed = report(true);
    assert!(printed.contains("5 parts measured, 0 were there"), "{printed}");
    let json = read_json(&place.join("report.json"));
    assert_eq!(json["success"].as_array().unwrap().len(), 2);
    assert_eq!(json["success"][0]["measured"]["episodes"], 2);
    assert_eq!(json["success"][0]["measured"]["fallback_answers"], 0);
    assert!(json["comparisons"][0]["ratio"].as_f64().is_some_and(|ratio| ratio > 0.0), "{json}");
    // 16 decisions are 17 observations, of which 3 are seen.
    assert_eq!(json["attention"][0]["measured"]["attention"]["share_of_h"].as_array().unwrap().len(), 14);
    assert_self_contained(&place, folder.path());
    // Nothing is measured twice, and without inputs the page is only drawn.
    let printed = report(true);
    assert!(printed.contains("0 parts measured, 5 were there"), "{printed}");
    let printed = report(false);
    assert!(printed.contains("drawn anew"), "{printed}");
    let again = read_json(&place.join("report.json"));
    for kind in ["success", "dynamics", "comparisons", "attention"] {
        assert_eq!(again[kind], json[kind], "{kind}");
    }
    assert_self_contained(&place, folder.path());
}

/// The page loads nothing and neither file names a folder of this machine.
fn assert_self_contained(report: &Path, folder: &Path) {
    let page = std::fs::read_to_string(report.join("index.html")).unwrap();
    let text = std::fs::read_to_string(report.join("report.json")).unwrap();
    for source in page.split("src=\"").skip(1) {
        assert!(source.starts_with("data:image/"), "{}", &source[..source.len().min(80)]);
    }
    for link in page.split("href=\"").skip(1) {
        assert!(link.starts_with('#'), "{}", &link[..link.len().min(80)]);
    }
    for loads in ["<script", "<link", "@import", "url(", "http://", "https://"] {
        assert!(!page.contains(loads), "{loads}");
    }
    let (folder, home) = (folder.to_string_lossy(), rcwm_tests::root().display().to_string());
    for path in [folder.as_ref(), home.as_str()] {
        assert!(!page.contains(path) && !text.contains(path), "{path}");
    }
    assert!(
        page.contains("data:image/gif") && page.contains("no policy"),
        "films, and tasks without a policy"
    );
}

#[test]
fn what_cannot_be_judged_is_one_clear_error() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let failed = |command| {
        let output = output(command);
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let mut command = domain.command("rcwm-trainer");
    command.args(["evaluate", "--task", "reach", "--engine", "trainer", "--bundle"]).arg(folder.path());
    let text = failed(command);
    assert!(text.contains("--checkpoint") && text.lines().count() == 1, "{text}");
    let rcwm = checkpoint(&domain, folder.path(), "rcwm");
    let text = failed(evaluate(&domain, &rcwm, &["--simulator", "/no/such/program"]));
    assert!(text.contains("/no/such/program") && text.lines().count() == 1, "{text}");
    let broken = binary("rcwm-trainer").display().to_string();
    let text = failed(evaluate(&domain, &rcwm, &["--simulator", &broken]));
    assert!(text.contains("rcwm-simulator") && text.contains("ended early"), "{text}");
}
