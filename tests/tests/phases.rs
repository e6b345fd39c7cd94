//! Phases that act: the trainer starts real simulators, learns in them, stops and goes on.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::process::Command;

use rcwm_tests::{Domain, Running, binary, eventually};
use rustix::process::Signal;

fn trainer(domain: &Domain, arguments: &[&str], out: &Path) -> Command {
    let mut command = domain.command("rcwm-trainer");
    command.env("RCWM_SIMULATOR", binary("rcwm-simulator")).args(arguments).arg("--out").arg(out);
    command
}

fn lines(out: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap_or_default();
    // The newest line may be half written.
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

fn episodes(out: &Path) -> Vec<serde_json::Value> {
    lines(out).into_iter().filter(|line| !line["episode"].is_null()).collect()
}

fn saved_episodes(out: &Path) -> usize {
    let files = std::fs::read_dir(out.join("episodes/reach")).unwrap();
    files.filter(|file| file.as_ref().unwrap().file_name().to_string_lossy().starts_with("step-")).count()
}

#[test]
fn training_from_scratch_acts_in_two_simulators_stops_and_goes_on() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let out = folder.path().join("run");
    let begin =
        ["train", "--task", "reach", "--preset", "debug", "--masks", "--set", "finetune.steps=100000"];
    let mut first = Running::start(trainer(&domain, &begin, &out));
    eventually("two episodes of the policy", || episodes(&out).len() >= 2);
    first.signal(Signal::INT);
    first.succeed();
    assert!(first.printed().contains("stopped and saved"), "{}", first.printed());
    assert_eq!(saved_episodes(&out), episodes(&out).len());
    let before = episodes(&out).last().unwrap()["episode"]["policy_steps"].as_u64().unwrap();

    let limit = format!("finetune.steps={}", before + 200);
    let go_on = ["train", "--resume", "--set", limit.as_str()];
    let mut second = Running::start(trainer(&domain, &go_on, &out));
    second.succeed();
    let after = episodes(&out);
    assert!(after.last().unwrap()["episode"]["policy_steps"].as_u64().unwrap() > before);
    assert_eq!(saved_episodes(&out), after.len());
    assert!(
        lines(&out).iter().any(|line| line["losses"]["robot_mask"].is_number()),
        "masks were learned from"
    );
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn fine_tuning_goes_from_a_checkpoint_of_another_phase() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (model, out) = (folder.path().join("model"), folder.path().join("run"));
    Running::start(trainer(&domain, &["init", "--preset", "debug"], &model)).succeed();
    let begin = [
        "finetune",
        "--task",
        "reach",
        "--simulators",
        "1",
        "--reset",
        "heads",
        "--from",
        model.to_str().unwrap(),
    ];
    let rest = ["--set", "finetune.steps=100", "--set", "finetune.warm_up_updates=2"];
    let mut run = Running::start(trainer(&domain, &[&begin[..], &rest].concat(), &out));
    run.succeed();
    assert!(run.printed().contains("100 steps, 1 episodes"), "{}", run.printed());
    assert!(out.join("checkpoints/last/checkpoint.toml").exists());
}

/// Separate episodes, on layouts that it never learns from, are rows of its metrics, and two seeds of them a curve of the report.
#[test]
fn a_run_is_evaluated_while_it_learns_and_the_report_draws_its_curve() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let mut report = domain.command("rcwm-trainer");
    report.args(["evaluate", "--report"]).arg(folder.path().join("report"));
    for seed in ["0", "1"] {
        let out = folder.path().join(seed);
        let begin = ["train", "--task", "reach", "--preset", "debug", "--simulators", "1", "--seed", seed];
        let rest = [
            "--set",
            "finetune.steps=60",
            "--set",
            "finetune.episode_steps=20",
            "--set",
            "finetune.warm_up_updates=1",
            "--set",
            "finetune.evaluation.every_steps=40",
            "--set",
            "finetune.evaluation.episodes=2",
        ];
        Running::start(trainer(&domain, &[&begin[..], &rest].concat(), &out)).succeed();
        let found: Vec<_> = lines(&out).into_iter().filter(|line| !line["evaluation"].is_null()).collect();
        let of = |key: &str| found.iter().map(|line| line["evaluation"][key].clone()).collect::<Vec<_>>();
        assert_eq!(of("policy_steps"), [0, 40]);
        assert_eq!((of("episodes"), of("layouts")), (vec![2.into(); 2], vec!["choosing".into(); 2]));
        report.arg("--runs").arg(format!("from scratch={}", out.display()));
    }
    Running::start(report).succeed();
    let read = rcwm_tests::read_json(&folder.path().join("report/report.json"));
    let curve = &read["learning_curves"][0];
    let steps: Vec<_> =
        curve["points"].as_array().unwrap().iter().map(|at| &at["environment_steps"]).collect();
    assert_eq!(steps, [0, 80]);
    assert_eq!(
        (&curve["label"], curve["points"][0]["rates"].as_array().unwrap().len()),
        (&"from scratch".into(), 2)
    );
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}
