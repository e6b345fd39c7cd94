//! Actions of any length, larger images, several cameras, and what the robot measures of itself.

#![allow(clippy::unwrap_used)]

mod support;

use assert_cmd::Command;
use candle_core::{Device, Tensor};
use ndarray::{Array1, Array2, Array3, Array4};
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::learning::{
    AdamSettings, Batch, Side, Trained, WorldLearner, WorldSettings, side_of, world_losses,
};
use rcwm_trainer::model::agent::{self, Agent};
use rcwm_trainer::model::latent::{FirstSteps, Sampler};
use rcwm_trainer::replay::{Folder, Replay};
use support::lively_parameters;

/// Seven numbers of action, two cameras of 128 x 128, fourteen numbers of state.
fn large(kind: ModelKind) -> ModelSettings {
    let debug = ModelSettings::preset(Preset::Debug, kind);
    ModelSettings { action: 7, image_side: 128, cameras: 2, state: 14, ..debug }
}

/// One camera of 64 x 64: quick to train.
fn small(kind: ModelKind) -> ModelSettings {
    ModelSettings { action: 3, state: 6, ..ModelSettings::preset(Preset::Debug, kind) }
}

/// A bright square, the robot, that goes where the actions push it; what the robot measures of itself is the sum of its actions, angles
/// and a hundred times as large velocities.
fn episode(model: &ModelSettings, steps: usize, phase: f32) -> Episode {
    let (side, cameras) = (model.image_side, model.cameras);
    let action = Array2::from_shape_fn((steps, model.action), |(t, i)| {
        if t == 0 { 0.0 } else { (0.4 * t as f32 + 1.3 * i as f32 + phase).sin() }
    });
    let state = Array2::from_shape_fn((steps, model.state), |(t, i)| {
        let moved = |t: usize| (0..=t).map(|t| action[[t, i % model.action]]).sum::<f32>();
        if i % 2 == 0 { moved(t) } else { 100.0 * action[[t, i % model.action]] }
    });
    let place = |t: usize| (24.0 + 4.0 * state[[t, 0]]) as usize;
    let is_robot =
        |t: usize, y: usize, x: usize| (place(t)..place(t) + 12).contains(&x) && (8..20).contains(&y);
    Episode {
        image: Array4::from_shape_fn((steps, side, side, 3 * cameras), |(t, y, x, c)| {
            if is_robot(t, y, x) { 220 } else { (20 + 10 * c + y / 2) as u8 }
        }),
        robot_mask: Some(Array3::from_shape_fn((steps, side, side * cameras), |(t, y, x)| {
            is_robot(t, y, x / cameras)
        })),
        reward: Array1::from_shape_fn(steps, |t| action[[t, 0]]),
        proprio: Some(state),
        action,
        ..Episode::blank_of(steps, side, cameras, model.action)
    }
}

fn replay(model: &ModelSettings) -> Replay {
    let mut replay = Replay::new(1000).fitting(model);
    for number in 0..4 {
        replay.add("reach", episode(model, 20, number as f32)).unwrap();
    }
    replay
}

fn batch(model: &ModelSettings, rows: usize, length: usize, masks: bool, number: u64) -> Batch {
    replay(model).draw(rows, length, masks, 5, number).unwrap().into_tensors(&Device::Cpu).unwrap()
}

fn largest(x: &Tensor) -> f32 {
    x.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar().unwrap()
}

#[test]
fn every_variable_of_a_model_with_states_gets_a_finite_gradient_that_is_not_zero() {
    // A softmax does not change when a constant is added to every key.
    const BLIND: &str = "interaction.key.bias";
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let model = large(kind);
        let parameters = lively_parameters(&model);
        let settings = WorldSettings { free_nats: 0.0, ..WorldSettings::default() };
        let learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
        let batch = batch(&model, 2, 3, true, 0);
        assert_eq!(batch.image.dims(), [2, 3, 128, 128, 6]);
        assert_eq!(batch.state.as_ref().unwrap().dims(), [2, 3, 14]);
        let losses = learner.losses(&batch, &mut Sampler::seeded(4)).unwrap();
        let values = losses.values().unwrap();
        assert!(values.state.unwrap() > 0.0 && values.robot_mask.unwrap() > 0.0, "{values:?}");
        let store = losses.total.backward().unwrap();
        for (name, var) in parameters.iter().filter(|(name, _)| Trained::World.filter()(name)) {
            let most = largest(store.get(var).unwrap_or_else(|| panic!("{name} gets no gradient")));
            assert!(most.is_finite() && (most > 0.0 || name == BLIND), "{kind:?} {name}: {most}");
        }
    }
}

#[test]
fn a_short_training_lowers_the_loss_of_the_state() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let model = small(kind);
        let parameters = agent::initialise(&model, 1, &Device::Cpu).unwrap();
        let adam = AdamSettings { learning_rate: 3e-3, ..WorldSettings::default().adam };
        let settings = WorldSettings { adam, ..WorldSettings::default() };
        let mut learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
        let losses: Vec<f64> = (0..60)
            .map(|number| {
                let batch = batch(&model, 4, 8, false, number);
                let update = learner.update(&batch, &mut Sampler::numbered(1, number)).unwrap();
                update.losses.state.unwrap()
            })
            .collect();
        let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
        let (first, last) = (mean(&losses[..5]), mean(&losses[55..]));
        assert!(last < 0.5 * first, "{kind:?}: {first} to {last}");
    }
}

/// Its size, too, and not only its direction: of a single number nothing else is left.
#[test]
fn a_state_ten_times_as_large_is_another_embedding() {
    let model = ModelSettings { state: 1, ..small(ModelKind::Rcwm) };
    let agent = Agent::new(&lively_parameters(&model).frozen(), &model).unwrap();
    let image = batch(&model, 1, 1, false, 0).image;
    let embedding = |size: f32| {
        let state = Tensor::new(&[[[size]]], &Device::Cpu).unwrap();
        let embeds = agent.world.encode(&image, Some(&state)).unwrap();
        embeds[0].narrow(2, 16 * 4 * model.cnn_depth, model.hidden).unwrap()
    };
    let (one, other) = (embedding(0.5), embedding(5.0));
    let (size, difference) = (largest(&one), largest(&(&one - &other).unwrap()));
    assert!(difference > 0.3 * size, "differs by {difference}, the largest number is {size}");
}

/// Episodes that are equal but for the state, so that only its encoder can have brought it there.
#[test]
fn a_state_that_nothing_else_tells_reaches_the_robots_latent_state() {
    let model = ModelSettings { state: 2, ..small(ModelKind::Rcwm) };
    let mut replay = Replay::new(2000).fitting(&model);
    for signs in [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] {
        let proprio = Some(Array2::from_shape_fn((20, 2), |(_, i)| signs[i]));
        replay.add("reach", Episode { proprio, ..episode(&model, 20, 0.0) }).unwrap();
    }
    let parameters = agent::initialise(&model, 1, &Device::Cpu).unwrap();
    let adam = AdamSettings { learning_rate: 3e-3, ..WorldSettings::default().adam };
    let settings = WorldSettings { adam, ..WorldSettings::default() };
    let mut learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
    let losses: Vec<f64> = (0..200)
        .map(|number| {
            let drawn = replay.draw(4, 8, false, 5, number).unwrap().into_tensors(&Device::Cpu).unwrap();
            learner.update(&drawn, &mut Sampler::numbered(1, number)).unwrap().losses.state.unwrap()
        })
        .collect();
    // Guessing the mean costs the variance: two numbers of symlog(1) squared.
    let (last, guessing) = (losses[180..].iter().sum::<f64>() / 20.0, 2.0 * 2.0_f64.ln().powi(2));
    assert!(last < 0.5 * guessing, "{last}, guessing costs {guessing}");
}

#[test]
fn the_loss_of_the_state_gives_the_environment_no_gradient() {
    let model = small(ModelKind::Rcwm);
    let parameters = lively_parameters(&model);
    let agent = Agent::new(&parameters.trainable(), &model).unwrap();
    let batch = batch(&model, 2, 4, false, 0);
    let losses = world_losses(&agent, &batch, &WorldSettings::default(), &mut Sampler::seeded(4)).unwrap();
    let store = losses.state.unwrap().backward().unwrap();
    let reached: Vec<&str> = parameters
        .iter()
        .filter(|(_, var)| store.get(var).is_some_and(|gradient| largest(gradient) > 0.0))
        .map(|(name, _)| name)
        .collect();
    assert!(reached.iter().all(|name| side_of(name) == Side::Robot), "{reached:?}");
    for part in ["encoder.state.", "encoder.shared.", "robot.posterior.", "robot.cell.", "decoder.state."] {
        assert!(reached.iter().any(|name| name.starts_with(part)), "{part} {reached:?}");
    }
    assert!(
        !reached.iter().any(|name| name.starts_with("decoder.robot.")),
        "the pictures' decoder has no part"
    );
}

#[test]
fn another_state_changes_the_robots_posterior_and_nothing_that_comes_from_images() {
    let model = large(ModelKind::Rcwm);
    let agent = Agent::new(&lively_parameters(&model).frozen(), &model).unwrap();
    let batch = batch(&model, 2, 1, false, 0);
    let state = batch.state.unwrap();
    let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let look = |state: &Tensor| {
        let embeds = agent.world.encode(&batch.image, Some(state)).unwrap();
        let first = FirstSteps::new(vec![true; 2], 1);
        let seen = agent.world.observe(&embeds, &batch.action, &first, &mut Sampler::Mode).unwrap();
        let of_images = embeds[0].narrow(2, 0, 16 * 4 * model.cnn_depth).unwrap();
        let of_state = embeds[0].narrow(2, 16 * 4 * model.cnn_depth, model.hidden).unwrap();
        let logits = seen.posteriors.branches.iter().map(|branch| numbers(&branch.logits));
        ([numbers(&of_images), numbers(&embeds[1])], numbers(&of_state), logits.collect::<Vec<_>>())
    };
    let (one, other) = (look(&state), look(&(&state + 1.0).unwrap()));
    assert_eq!(one.0, other.0, "both branches' image embeddings");
    assert_ne!(one.1, other.1);
    assert_ne!(one.2[0], other.2[0], "the robot's posterior");
    assert_eq!(one.2[1], other.2[1], "the environment's posterior at the first step");
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let model = large(ModelKind::Rcwm);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.npz");
    episode(&small(ModelKind::Rcwm), 3, 0.0).write(&file).unwrap();
    let load = |model: &ModelSettings| {
        let replay = Replay::new(100).fitting(model);
        Folder::list(folder.path(), None).unwrap().load(replay, || ()).map_err(|error| error.to_string())
    };
    let text = load(&model).unwrap_err();
    for part in [file.to_str().unwrap(), "64 x 64 of 1 camera", "128 x 128 of 2 cameras"] {
        assert!(text.contains(part) && text.lines().count() == 1, "{text}");
    }
    let text = load(&ModelSettings { state: 7, ..small(ModelKind::Rcwm) }).unwrap_err();
    assert!(text.contains("proprio") && text.contains("of 6 numbers, expected of 7"), "{text}");
    let without = load(&ModelSettings { state: 0, ..small(ModelKind::Rcwm) }).unwrap();
    assert!(without.draw(1, 2, false, 0, 0).unwrap().state.is_empty(), "not read where it is not wanted");

    let agent = Agent::new(&lively_parameters(&model).frozen(), &model).unwrap();
    let batch = batch(&model, 1, 1, false, 0);
    let missing = agent.world.encode(&batch.image, None).unwrap_err().to_string();
    assert!(missing.contains("14 numbers") && missing.contains("none was given"), "{missing}");
}

#[test]
fn the_commands_take_the_sizes_and_refuse_what_they_do_not_have() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rcwm-trainer"));
        command.current_dir(folder.path()).args(arguments).assert()
    };
    let sizes = ["action=7", "image_side=128", "cameras=2", "state=14"].map(|size| format!("model.{size}"));
    let sizes: Vec<&str> = sizes.iter().flat_map(|size| ["--set", size]).collect();
    run(&[&["init", "--preset", "debug", "--out", "made"], sizes.as_slice()].concat()).success();
    let made = Checkpoint::read(&folder.path().join("made"), &Device::Cpu).unwrap();
    assert_eq!(made.settings.model, large(ModelKind::Rcwm));
    let refused = run(&["init", "--out", "other", "--set", "model.image_side=96"]).failure();
    let text = String::from_utf8(refused.get_output().stderr.clone()).unwrap();
    assert!(text.contains("image_side = 96, expected 64 or 128") && text.lines().count() == 1, "{text}");

    let data = folder.path().join("data/reach");
    std::fs::create_dir_all(&data).unwrap();
    for number in 0..2 {
        let path = data.join(format!("{number}.npz"));
        episode(&large(ModelKind::Rcwm), 20, number as f32).write(&path).unwrap();
    }
    let updates =
        ["--set", "pretrain.updates=2", "--set", "pretrain.warm_up_updates=1", "--set", "metrics_every=1"];
    let pretrain = ["pretrain", "--preset", "debug", "--data", "data", "--out", "run"];
    run(&[&pretrain[..], &sizes, &updates].concat()).success();
    let metrics = std::fs::read_to_string(folder.path().join("run/metrics.jsonl")).unwrap();
    assert!(metrics.lines().all(|line| line.contains("\"state_loss\":")), "{metrics}");

    let evaluate =
        ["evaluate", "--data", "data", "--windows", "anywhere", "--context", "4", "--imagined", "6"];
    let of = |checkpoint| [&evaluate[..], &["--checkpoint", checkpoint, "--out", "shown"]].concat();
    run(&of("run/checkpoints/last")).success();
    assert!(folder.path().join("shown/robot_error.png").is_file());
    let task = ["--task", "reach", "--out", "acted"];
    for verb in [&["train", "--preset", "debug"][..], &["finetune", "--from", "made"]] {
        let sizes = if verb[0] == "train" { &sizes[..2] } else { &[] };
        let refused = run(&[verb, &task, sizes].concat()).failure();
        let text = String::from_utf8(refused.get_output().stderr.clone()).unwrap();
        assert!(text.contains("acting in simulators takes") && text.lines().count() == 1, "{text}");
        assert!(!folder.path().join("acted").exists());
    }
    let refused = run(&["evaluate", "--task", "reach", "--checkpoint", "made"]).failure();
    let text = String::from_utf8(refused.get_output().stderr.clone()).unwrap();
    assert!(text.contains("acting in simulators takes"), "{text}");
    run(&["init", "--preset", "debug", "--out", "small"]).success();
    let refused = run(&of("small")).failure();
    let text = String::from_utf8(refused.get_output().stderr.clone()).unwrap();
    assert!(text.contains("0.npz") && text.contains("expected 64 x 64 of 1 camera"), "{text}");
}
