//! A run of the real simulator is logged, replayed bit for bit, and learned from.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rcwm_models::episode::Episode;
use rcwm_tests::{Domain, Running, read_json, shipped_bundle};

#[test]
fn a_logged_run_is_replayed_bit_for_bit_and_the_trainer_learns_from_it() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let at = |name: &str| folder.path().join(name);
    let mut simulator = domain.command("rcwm-simulator");
    simulator.args([
        "serve",
        "--task",
        "reach",
        "--instance",
        "log",
        "--episodes",
        "2",
        "--steps-max",
        "25",
        "--masks",
    ]);
    let mut simulator = Running::start(simulator);
    let mut run = domain.command("rcwm-runtime");
    run.args(["run", "--instance", "log", "--sample", "--seed", "4", "--bundle"]).arg(shipped_bundle());
    run.arg("--log").arg(at("run.rcwmlog"));
    let mut run = Running::start(run);
    simulator.succeed();
    run.succeed();

    let mut replay = domain.command("rcwm-lab");
    replay.args(["replay", "--bundle"]).arg(shipped_bundle()).arg("--log").arg(at("run.rcwmlog"));
    replay.arg("--episodes").arg(at("data")).arg("--json").arg(at("replay.json"));
    let mut replay = Running::start(replay);
    replay.succeed();
    let report = read_json(&at("replay.json"));
    assert_eq!((&report["ticks_compared"], &report["ticks_differing"]), (&52.into(), &0.into()), "{report}");
    // Named by instance and start of the run.
    let files: Vec<_> = std::fs::read_dir(at("data").join("reach")).unwrap().collect();
    assert_eq!(files.len(), 2, "{files:?}");
    for file in files {
        let episode = Episode::read(&file.unwrap().path()).unwrap();
        assert_eq!(episode.len(), 26);
        assert!(episode.robot_mask.is_some_and(|mask| mask.iter().any(|robot| *robot)));
    }

    let mut trainer = domain.command("rcwm-trainer");
    trainer.args([
        "pretrain",
        "--preset",
        "debug",
        "--set",
        "pretrain.updates=3",
        "--set",
        "film.length=0",
        "--data",
    ]);
    trainer.arg(at("data")).arg("--out").arg(at("run"));
    let mut trainer = Running::start(trainer);
    trainer.succeed();
    assert!(at("run/checkpoints/last").is_dir(), "{}", trainer.printed());
}
