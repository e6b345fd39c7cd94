//! A new task from demonstrations alone: stages, resuming, and the same by programs of kernels.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::Device;
use rcwm_gpu::Machine;
use rcwm_models::settings::{ModelKind, Preset};
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::gpu::Share;
use rcwm_trainer::learning::{CloningLoss, Side, side_of};
use rcwm_trainer::replay::Starts;
use rcwm_trainer::training::{Compute, Fewshot, Outcome, Phase, Run, Stage, TrainingError, TrainingSettings};
use support::{bits, changed, pretrained, replay};

fn settings(kind: ModelKind) -> TrainingSettings {
    let mut settings = TrainingSettings::preset(Preset::Debug, kind, "memory".into());
    settings.phase = Phase::Fewshot;
    settings.seed = 3;
    settings.metrics_every = 2;
    settings.checkpoint_every = 7;
    settings.behaviour.horizon.length = 3;
    settings
}

fn learn(fewshot: &mut Fewshot, until: u64) -> Outcome {
    let stop = AtomicBool::new(false);
    fewshot.run(replay(), &stop, |progress| stop.store(progress.updates >= until, Ordering::Relaxed)).unwrap()
}

fn updates_logged(folder: &Path) -> Vec<u64> {
    let text = fs::read_to_string(folder.join("metrics.jsonl")).unwrap();
    let update =
        |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["update"].as_u64().unwrap();
    text.lines().map(update).collect()
}

#[test]
fn few_shot_learning_that_was_interrupted_in_any_stage_gives_the_same_weights() {
    let cases = [
        (ModelKind::Rcwm, false, false),
        (ModelKind::Rcwm, true, false),
        (ModelKind::Rcwm, false, true),
        (ModelKind::Vanilla, false, true),
    ];
    interrupted_is_the_same_as_whole(|| (&Device::Cpu).into(), &cases);
}

fn programs() -> Compute {
    Compute::Programs(Share::alone(Machine::host()))
}

#[test]
fn few_shot_learning_by_programs_does_too() {
    let cases = [(ModelKind::Rcwm, false, true), (ModelKind::Vanilla, false, false)];
    interrupted_is_the_same_as_whole(programs, &cases);
}

#[test]
fn few_shot_learning_by_programs_learns_what_tensors_learn() {
    for (kind, loss, scale) in [
        (ModelKind::Rcwm, CloningLoss::SquaredError, 10.0),
        (ModelKind::Rcwm, CloningLoss::Likelihood, 10.0),
        (ModelKind::Rcwm, CloningLoss::SquaredError, 0.0),
        (ModelKind::Vanilla, CloningLoss::SquaredError, 10.0),
    ] {
        let source = pretrained(kind);
        let run = |compute: Compute| {
            let folder = tempfile::tempdir().unwrap();
            let mut settings = settings(kind);
            settings.metrics_every = 1;
            settings.world.environment_learning_rate = 2.0 * settings.world.adam.learning_rate;
            settings.fewshot.imitation_scale = scale;
            settings.fewshot.cloning.loss = loss;
            settings.fewshot.shift = 2;
            let mut learning = Fewshot::create(folder.path(), settings, &source, compute).unwrap();
            learn(&mut learning, 8);
            let text = fs::read_to_string(folder.path().join("metrics.jsonl")).unwrap();
            text.lines()
                .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap())
                .collect::<Vec<_>>()
        };
        let (tensors, programs) = (run((&Device::Cpu).into()), run(programs()));
        assert_eq!((tensors.len(), programs.len()), (8, 8));
        for (at, (expected, found)) in tensors.iter().zip(&programs).enumerate() {
            for (values, name) in [("losses", "cloning"), ("losses", "total"), ("losses", "image")] {
                let value = |line: &serde_json::Value| line[values][name].as_f64();
                assert_eq!(value(expected).is_some(), name != "cloning" || scale > 0.0);
                let (Some(expected), Some(found)) = (value(expected), value(found)) else { continue };
                let tolerance = if at == 0 { 1e-4 } else { 2e-2 };
                let text = format!("{kind:?} {loss:?} update {at}: {name} {found}, expected {expected}");
                assert!((found - expected).abs() <= tolerance * expected.abs().max(1.0), "{text}");
            }
            // The norm is of all that is trained, the actor too.
            let norm = |line: &serde_json::Value| line["gradient_norm"].as_f64().unwrap();
            let (expected, found) = (norm(expected), norm(found));
            let tolerance = if at == 0 { 1e-3 } else { 0.1 };
            assert!(
                (found - expected).abs() <= tolerance * expected,
                "{kind:?} {at}: norm {found}, expected {expected}"
            );
        }
    }
}

#[test]
fn a_world_model_that_goes_on_with_the_actor_is_refused_on_a_gpu() {
    let folder = tempfile::tempdir().unwrap();
    let mut settings = settings(ModelKind::Rcwm);
    settings.fewshot.world_goes_on = true;
    let refused = Fewshot::create(folder.path(), settings, &pretrained(ModelKind::Rcwm), programs());
    assert!(refused.unwrap_err().to_string().contains("fewshot.world_goes_on"));
}

/// Cases are a kind of model, whether the world model goes on with the actor, and whether the actor has a part in its loss.
fn interrupted_is_the_same_as_whole(compute: impl Fn() -> Compute, cases: &[(ModelKind, bool, bool)]) {
    for &(kind, world_goes_on, imitates) in cases {
        let folder = tempfile::tempdir().unwrap();
        let (whole, parts) = (folder.path().join("whole"), folder.path().join("parts"));
        let mut settings = settings(kind);
        settings.fewshot.world_goes_on = world_goes_on;
        if imitates {
            settings.fewshot.imitation_scale = 10.0;
            settings.fewshot.starts = Starts::Episodes;
            settings.fewshot.shift = 2;
            settings.world.decode_every = 2;
        }
        let source = pretrained(kind);
        let mut learning = Fewshot::create(&whole, settings.clone(), &source, compute()).unwrap();
        assert_eq!(learn(&mut learning, u64::MAX), Outcome { updates: 20, interrupted: false });
        assert!(whole.join("films/000020-hammer.png").exists() && whole.join("curves.png").exists());
        let expected = bits(learning.parameters());

        let mut learning = Fewshot::create(&parts, settings.clone(), &source, compute()).unwrap();
        for stop in [2, 6, 12, 13, u64::MAX] {
            learn(&mut learning, stop);
            assert_eq!(learning.updates(), stop.min(20));
            drop(learning);
            learning = Fewshot::resume(&parts, Run::settings(&parts).unwrap(), compute()).unwrap();
        }
        assert!(
            bits(learning.parameters()) == expected,
            "{kind:?}, {world_goes_on}, {imitates}: not the same bits"
        );
        assert_eq!(updates_logged(&parts), updates_logged(&whole));
        let stored = |folder| bits(&Checkpoint::read(&Run::last(folder), &Device::Cpu).unwrap().parameters);
        assert!(
            stored(&parts) == stored(&whole),
            "{kind:?}, {world_goes_on}, {imitates}: not the same average"
        );
        let averaged = changed(&stored(&whole), &expected);
        let moves =
            |name: &String| world_goes_on || !matches!(side_of(name), Side::Robot | Side::Environment);
        assert!(!averaged.is_empty() && averaged.iter().all(moves), "{averaged:?}");
    }
}

#[test]
fn each_stage_moves_its_own_part_alone() {
    let folder = tempfile::tempdir().unwrap();
    let source = pretrained(ModelKind::Rcwm);
    let mut settings = settings(ModelKind::Rcwm);
    settings.reset.keep_behaviour = true;
    // Where there is an average, the actor's stage begins with it in the place of all weights.
    settings.average_decay = 0.0;
    let mut learning = Fewshot::create(folder.path(), settings.clone(), &source, &Device::Cpu).unwrap();
    let mut before = bits(learning.parameters());
    for (until, stage) in [(4, Stage::Environment), (8, Stage::World), (20, Stage::Actor)] {
        learn(&mut learning, until);
        assert_eq!(Stage::of(&settings.fewshot, until - 1).0, stage);
        let after = bits(learning.parameters());
        let moved = changed(&before, &after);
        let trains = |side| match stage {
            Stage::Environment => side == Side::Environment,
            Stage::World => matches!(side, Side::Robot | Side::Environment),
            Stage::Actor => matches!(side, Side::Actor | Side::Critic | Side::SlowCritic),
        };
        assert!(moved.iter().all(|name| trains(side_of(name))), "{stage:?}: {moved:?}");
        let all = before.keys().filter(|name| trains(side_of(name))).count();
        // Where the key's bias has no true gradient, rounding may leave it.
        assert!(moved.len() + 1 >= all, "{stage:?}: {} of {all} moved", moved.len());
        before = after;
    }
}

#[test]
fn a_run_of_another_kind_is_not_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let settings = settings(ModelKind::Rcwm);
    let pretraining = TrainingSettings { phase: Phase::Pretrain, ..settings };
    let refused = Fewshot::resume(folder.path(), pretraining, &Device::Cpu);
    assert!(matches!(refused, Err(TrainingError::OtherPhase { found: "pretrain", .. })));
}
