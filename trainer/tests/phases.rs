//! What a new task starts from, and learning it from demonstrations alone.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;

use candle_core::{Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::IMAGE_BYTES;
use rcwm_models::settings::{ModelKind, Preset};
use rcwm_trainer::behaviour::BehaviourSettings;
use rcwm_trainer::cloning::{CloningLearner, CloningSettings, Ramp};
use rcwm_trainer::learning::{CloningLoss, Examples, actions_taken};
use rcwm_trainer::learning::{HostBatch, Side, side_of};
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::replay::Replay;
use rcwm_trainer::training::{
    FewshotSettings, Phase, Pretraining, Reset, ResetSettings, TrainingError, TrainingSettings,
    demonstrations, start_from,
};
use support::{bits, changed, episode, pretrained};

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
        assert_eq!(action, episode.action.row(t + 1).to_vec());
    }
    // In a batch that runs on into another episode the last state of the first has no action.
    let features = Tensor::arange(0f32, 6.0, &Device::Cpu).unwrap().reshape((2, 3, 1)).unwrap();
    let first = [true, false, true, false, false, false];
    let batch = HostBatch {
        side: 64,
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
        let replay = demonstrations(folder.path(), task, &settings, Replay::new(1000), || ()).unwrap();
        let lengths = replay.tasks().flat_map(|(_, episodes)| episodes.into_iter().map(|e| e.len()));
        lengths.collect::<Vec<_>>()
    };
    assert_eq!(found("hammer", 2), [5, 6]);
    // Two steps after the success, which is at the last step but one.
    let settings = FewshotSettings { steps_after_success: 0, ..FewshotSettings::default() };
    let replay = demonstrations(folder.path(), "reach", &settings, Replay::new(1000), || ()).unwrap();
    let (_, episodes) = replay.tasks().next().unwrap();
    assert!(
        episodes[0].len() <= 8 && episodes[0].success.iter().position(|s| *s) == Some(episodes[0].len() - 1)
    );
    assert_eq!(found("", 9), [5, 6, 7, 8]);
    fs::remove_dir_all(folder.path().join("reach")).unwrap();
    for name in ["b", "c", "d"] {
        fs::remove_file(folder.path().join("hammer").join(name).with_extension("npz")).unwrap();
    }
    let none = demonstrations(folder.path(), "hammer", &FewshotSettings::default(), Replay::new(1000), || ());
    assert!(matches!(none, Err(TrainingError::NoDemonstrations { episodes: 1, .. })));
}
