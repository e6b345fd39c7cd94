//! What a new task starts from, and learning it from demonstrations alone.

#![allow(clippy::unwrap_used)]

mod support;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::{Device, Tensor};
use ndarray::{Array1, Array2, Array4};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_gpu::Machine;
use rcwm_models::IMAGE_BYTES;
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, Preset};
use rcwm_trainer::behaviour::BehaviourSettings;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::cloning::{CloningLearner, CloningSettings, Ramp};
use rcwm_trainer::gpu::Share;
use rcwm_trainer::learning::{CloningLoss, Examples, actions_taken};
use rcwm_trainer::learning::{HostBatch, Side, side_of};
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::replay::{Replay, Starts};
use rcwm_trainer::training::{
    Compute, Fewshot, FewshotSettings, Outcome, Phase, Pretraining, Reset, ResetSettings, Run, Stage,
    TrainingError, TrainingSettings, demonstrations, start_from,
};

/// A bright square that moves with the action, to and fro.
fn episode(steps: usize, shift: usize, success: bool) -> Episode {
    let inside = |t: usize, y: usize, x: usize| (8..24).contains(&y) && (x + 64 - (t + shift) % 64) % 64 < 16;
    let flag = |at: usize, value: bool| Array1::from_shape_fn(steps, |t| value && t == at);
    Episode {
        image: Array4::from_shape_fn(
            (steps, 64, 64, 3),
            |(t, y, x, _)| if inside(t, y, x) { 220 } else { 30 },
        ),
        action: Array2::from_shape_fn((steps, 4), |(t, i)| {
            if t == 0 { 0.0 } else { 0.3 + 0.1 * i as f32 - 0.01 * t as f32 }
        }),
        reward: (0..steps).map(|t| t as f32 * 0.1).collect(),
        is_last: flag(steps - 1, true),
        success: flag(steps / 2, success),
        ..Episode::blank(steps)
    }
}

fn replay() -> Replay {
    let mut replay = Replay::new(1000);
    for (steps, shift) in [(20, 0), (15, 9), (30, 30)] {
        replay.add("hammer", episode(steps, shift, true)).unwrap();
    }
    replay
}

type Bits = BTreeMap<String, Vec<u32>>;

fn bits(parameters: &Parameters) -> Bits {
    let bits = |var: &candle_core::Var| {
        var.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
    };
    parameters.iter().map(|(name, var)| (name.to_owned(), bits(var))).collect()
}

/// Names of the parameters that differ.
fn changed(before: &Bits, after: &Bits) -> Vec<String> {
    before.iter().filter(|(name, bits)| after[*name] != **bits).map(|(name, _)| name.clone()).collect()
}

/// A model whose every parameter is away from where it starts.
fn pretrained(kind: ModelKind) -> Checkpoint {
    let checkpoint = support::untrained(kind, 1);
    let mut generator = ChaCha8Rng::seed_from_u64(2);
    for (_, var) in checkpoint.parameters.iter() {
        let noise: Vec<f32> = (0..var.elem_count()).map(|_| generator.random_range(0.01..0.05)).collect();
        let noise = Tensor::from_vec(noise, var.dims(), &Device::Cpu).unwrap();
        var.set(&(var.as_tensor() + noise).unwrap().detach()).unwrap();
    }
    checkpoint
}

#[test]
fn a_run_is_resumed_by_the_verb_that_made_it_only() {
    let folder = tempfile::tempdir().unwrap();
    let mut settings = TrainingSettings::preset(Preset::Debug, ModelKind::Rcwm, "memory".into());
    Pretraining::create(folder.path(), settings.clone(), &Device::Cpu).unwrap();
    settings.phase = Phase::Fewshot;
    let error = Pretraining::resume(folder.path(), settings, &Device::Cpu).unwrap_err().to_string();
    assert!(error.contains("rcwm-trainer fewshot --resume"), "{error}");
}

#[test]
fn a_reset_draws_exactly_its_parts_anew_and_leaves_every_other_bit() {
    let source = pretrained(ModelKind::Rcwm);
    let before = bits(&source.parameters);
    let parts = |name: &str, parts: &[&str]| parts.contains(&name.split('.').next().unwrap());
    for (reset, anew) in [
        (Reset::None, &[][..]),
        (Reset::Heads, &["heads"]),
        (Reset::HeadsEnvironment, &["heads", "environment"]),
        (Reset::AllButRobot, &["heads", "environment", "interaction"]),
    ] {
        let settings = ResetSettings { parts: reset, keep_behaviour: true };
        let started = start_from(&source, &settings, 7, &Device::Cpu).unwrap();
        let expected: Vec<_> = before.keys().filter(|name| parts(name, anew)).cloned().collect();
        assert_eq!(changed(&before, &bits(&started)), expected, "{reset:?}");
        let again = start_from(&source, &settings, 7, &Device::Cpu).unwrap();
        assert!(bits(&again) == bits(&started), "the seed decides");
    }
    assert!(bits(&source.parameters) == before, "the source is left alone");
}

#[test]
fn a_reset_draws_the_interaction_anew_at_full_scale() {
    let source = pretrained(ModelKind::Rcwm);
    for (_, var) in source.parameters.iter().filter(|(name, _)| name.starts_with("interaction.")) {
        var.set(&var.zeros_like().unwrap()).unwrap();
    }
    let started = start_from(&source, &ResetSettings::default(), 7, &Device::Cpu).unwrap();
    for layer in ["deter", "query", "key", "value", "output"] {
        let values = |kind: &str| {
            let var = started.get(&format!("interaction.{layer}.{kind}")).unwrap();
            var.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        support::assert_full_scale(layer, &values("weight"));
        assert!(values("bias").iter().all(|value| *value == 0.0), "{layer}");
    }
}

#[test]
fn the_actor_and_both_critics_start_anew_unless_they_are_kept() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let source = pretrained(kind);
        let settings = ResetSettings { parts: Reset::None, keep_behaviour: false };
        let started = bits(&start_from(&source, &settings, 7, &Device::Cpu).unwrap());
        let before = bits(&source.parameters);
        for name in changed(&before, &started) {
            assert!(!matches!(side_of(&name), Side::Robot | Side::Environment), "{name}");
        }
        for (name, value) in started.iter().filter(|(name, _)| name.starts_with("slow_critic")) {
            assert_eq!(
                value,
                &started[name.strip_prefix("slow_").unwrap()],
                "it starts as the critic's copy"
            );
            assert_ne!(value, &before[name]);
        }
    }
}

#[test]
fn the_baseline_keeps_its_world_model_whatever_is_asked() {
    let source = pretrained(ModelKind::Vanilla);
    let settings = ResetSettings { parts: Reset::AllButRobot, keep_behaviour: true };
    let started = start_from(&source, &settings, 7, &Device::Cpu).unwrap();
    assert_eq!(changed(&bits(&source.parameters), &bits(&started)), Vec::<String>::new());
}

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

/// Features whose action is a function of them that an actor can learn.
fn toy(generator: &mut ChaCha8Rng, rows: usize, width: usize) -> (Tensor, Tensor) {
    let features: Vec<f32> = (0..rows * width).map(|_| generator.random_range(-1.0..1.0)).collect();
    let action = |row: &[f32], i: usize| (0.8 * row[i] - 0.4 * row[i + 4]).tanh();
    let actions: Vec<f32> =
        features.chunks(width).flat_map(|row| (0..4).map(move |i| action(row, i))).collect();
    let features = Tensor::from_vec(features, (rows, width), &Device::Cpu).unwrap();
    (features, Tensor::from_vec(actions, (rows, 4), &Device::Cpu).unwrap())
}

#[test]
fn cloning_learns_a_mapping_with_either_loss() {
    for loss in [CloningLoss::SquaredError, CloningLoss::Likelihood] {
        let source = support::untrained(ModelKind::Rcwm, 4);
        let model = &source.settings.model;
        let mut settings = CloningSettings {
            loss,
            weight: Ramp { first: 1.0, last: 1.0, updates: 0 },
            imagination_weight: Ramp { first: 0.0, last: 0.0, updates: 0 },
            ..CloningSettings::default()
        };
        settings.actor.learning_rate = 3e-3;
        let mut learner =
            CloningLearner::new(&source.parameters, model, &settings, &BehaviourSettings::default()).unwrap();
        let mut generator = ChaCha8Rng::seed_from_u64(9);
        let (features, actions) = toy(&mut generator, 2048, model.state_width());
        let examples = Examples::new(features, actions);
        let before = bits(&source.parameters);
        let mut losses = Vec::new();
        for number in 0..300 {
            let (features, actions) = examples.draw(128, 0, number).unwrap();
            let start = || panic!("nothing is imagined where it does not count");
            let update =
                learner.update(number, &features, &actions, start, &mut Sampler::seeded(number)).unwrap();
            losses.push(update.loss);
        }
        let (first, last) = (losses[0], losses[290..].iter().sum::<f64>() / 10.0);
        let learned = match loss {
            CloningLoss::SquaredError => last < 0.1 * first,
            CloningLoss::Likelihood => last < first - 1.0,
        };
        assert!(learned, "{loss:?}: {first} to {last}");
        let moved = changed(&before, &bits(&source.parameters));
        assert!(!moved.is_empty() && moved.iter().all(|name| side_of(name) == Side::Actor), "{moved:?}");
    }
}

#[test]
fn the_action_of_a_state_is_the_one_that_led_to_the_next_image() {
    let episode = episode(5, 0, true);
    let taken: Vec<_> = actions_taken(&episode).collect();
    assert_eq!(taken.len(), 4);
    for (t, action) in taken {
        assert_eq!(action.to_vec(), episode.action.row(t + 1).to_vec());
    }
    // In a batch that runs on into another episode the last state of the first has no action.
    let features = Tensor::arange(0f32, 6.0, &Device::Cpu).unwrap().reshape((2, 3, 1)).unwrap();
    let first = [true, false, true, false, false, false];
    let batch = HostBatch {
        rows: 2,
        length: 3,
        image: vec![0; 6 * IMAGE_BYTES],
        action: (0..24).map(|x| 0.125 * (x / 4) as f32).collect(),
        reward: vec![0.0; 6],
        terminal: vec![false; 6],
        first: first.to_vec(),
        // And what was a push is no example.
        pushed: vec![false, false, false, false, true, false],
        ..HostBatch::default()
    };
    let batch = batch.into_tensors(&Device::Cpu).unwrap();
    let (features, actions) = Examples::of_batch(&features, &batch).unwrap();
    assert_eq!(features.flatten_all().unwrap().to_vec1::<f32>().unwrap(), [0.0, 4.0]);
    assert_eq!(actions.to_vec2::<f32>().unwrap(), [[0.125; 4], [0.625; 4]]);
}

#[test]
fn only_successful_episodes_of_the_task_are_demonstrations() {
    let folder = tempfile::tempdir().unwrap();
    for (task, name, steps, success) in [
        ("hammer", "a", 4, false),
        ("hammer", "b", 5, true),
        ("hammer", "c", 6, true),
        ("hammer", "d", 7, true),
        ("reach", "a", 8, true),
    ] {
        fs::create_dir_all(folder.path().join(task)).unwrap();
        let path = folder.path().join(task).join(name).with_extension("npz");
        episode(steps, 0, success).write(&path).unwrap();
    }
    let found = |task: &str, count| {
        let settings = FewshotSettings { demonstrations: count, ..FewshotSettings::default() };
        let replay = demonstrations(folder.path(), task, &settings, 1000, || ()).unwrap();
        let lengths = replay.tasks().flat_map(|(_, episodes)| episodes.into_iter().map(|e| e.len()));
        lengths.collect::<Vec<_>>()
    };
    assert_eq!(found("hammer", 2), [5, 6]);
    // Two steps after the success, which is at the last step but one.
    let settings = FewshotSettings { steps_after_success: 0, ..FewshotSettings::default() };
    let replay = demonstrations(folder.path(), "reach", &settings, 1000, || ()).unwrap();
    let (_, episodes) = replay.tasks().next().unwrap();
    assert!(
        episodes[0].len() <= 8 && episodes[0].success.iter().position(|s| *s) == Some(episodes[0].len() - 1)
    );
    assert_eq!(found("", 9), [5, 6, 7, 8]);
    fs::remove_dir_all(folder.path().join("reach")).unwrap();
    for name in ["b", "c", "d"] {
        fs::remove_file(folder.path().join("hammer").join(name).with_extension("npz")).unwrap();
    }
    let none = demonstrations(folder.path(), "hammer", &FewshotSettings::default(), 1000, || ());
    assert!(matches!(none, Err(TrainingError::NoDemonstrations { episodes: 1, .. })));
}
