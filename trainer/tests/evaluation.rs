//! Open-loop evaluation of whole models on episodes that are made up.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use std::sync::atomic::AtomicBool;

use candle_core::Device;
use ndarray::{Array2, Array3, Array4};
use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelKind;
use rcwm_trainer::evaluation::{
    Comparison, EvaluationError, Latents, Measure, Measured, ModelReport, OpenLoopReport, OpenLoopSettings,
    TaskReport, TaskTrajectories, filtered, imagined, joined, measure, open_loop,
};
use rcwm_trainer::model::agent::Agent;
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::replay::Replay;

/// A bright bar, the robot, that moves.
fn episode(steps: usize, shift: usize, masked: bool) -> Episode {
    let inside = |t: usize, y: usize, x: usize| (8..24).contains(&y) && (x + t + shift) % 64 < 16;
    Episode {
        image: Array4::from_shape_fn(
            (steps, 64, 64, 3),
            |(t, y, x, _)| if inside(t, y, x) { 220 } else { 30 },
        ),
        action: Array2::from_shape_fn((steps, 4), |(t, i)| ((t * 3 + i) % 7) as f32 / 7.0),
        reward: (0..steps).map(|t| t as f32 * 0.1).collect(),
        robot_mask: masked.then(|| Array3::from_shape_fn((steps, 64, 64), |(t, y, x)| inside(t, y, x))),
        ..Episode::blank(steps)
    }
}

fn replay() -> Replay {
    let mut replay = Replay::new(10_000);
    for shift in 0..5 {
        replay.add("reach", episode(20 + shift, 7 * shift, true)).unwrap();
    }
    replay.add("reach", episode(40, 3, false)).unwrap();
    replay.add("reach", episode(9, 3, true)).unwrap();
    replay
}

fn agent(kind: ModelKind) -> Agent {
    let checkpoint = support::untrained(kind, 3);
    Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model).unwrap()
}

fn settings(latents: Latents) -> OpenLoopSettings {
    OpenLoopSettings { trajectories: 12, context: 4, imagined: 8, latents, seed: 5, films: 1 }
}

fn tasks(seed: u64) -> Vec<TaskTrajectories> {
    TaskTrajectories::choose(&replay(), 12, 12, seed).unwrap()
}

fn run(kind: ModelKind, latents: Latents) -> Measured {
    let stop = AtomicBool::new(false);
    measure(&agent(kind), &tasks(5)[0], &settings(latents), &Device::Cpu, &stop, |_| ()).unwrap()
}

#[test]
fn trajectories_are_distinct_lie_within_masked_episodes_and_repeat_with_the_seed() {
    let places = |seed| -> Vec<(usize, usize)> {
        tasks(seed)[0].chosen.iter().map(|chosen| (chosen.number, chosen.start)).collect()
    };
    let mut found = places(5);
    assert_eq!(found, places(5));
    assert_ne!(found, places(6));
    for chosen in &tasks(5)[0].chosen {
        assert!(chosen.episode.robot_mask.is_some() && chosen.start + 12 <= chosen.episode.len());
    }
    found.sort_unstable();
    found.dedup();
    assert_eq!(found.len(), 12);
    assert_eq!(tasks(5)[0].episodes(), 5, "equally many of each episode");
    // More than there are: every start once.
    let all = &TaskTrajectories::choose(&replay(), 1000, 12, 0).unwrap()[0];
    assert_eq!(all.chosen.len(), (20..25).map(|steps| steps - 12 + 1).sum::<usize>());
}

#[test]
fn data_without_masks_or_too_short_is_one_clear_error() {
    let mut without = Replay::new(100);
    without.add("reach", episode(40, 0, false)).unwrap();
    assert!(matches!(TaskTrajectories::choose(&without, 5, 12, 0), Err(EvaluationError::NoMasks)));
    let short = TaskTrajectories::choose(&replay(), 5, 64, 0);
    assert!(matches!(short, Err(EvaluationError::NoTrajectories { episodes: 6, length: 64, .. })));
}

#[test]
fn a_model_sees_nothing_of_what_comes_after_the_context() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let (agent, task) = (agent(kind), &tasks(5)[0]);
        let batch = task.batch(0, 3, &Device::Cpu).unwrap();
        let mut blind = batch.clone();
        let dark = blind.image.narrow(1, 4, 8).unwrap().zeros_like().unwrap();
        let seen = blind.image.narrow(1, 0, 4).unwrap();
        blind.image = candle_core::Tensor::cat(&[&seen, &dark], 1).unwrap();
        let features = |batch| {
            let states = open_loop(&agent.world, batch, 4, &mut Sampler::Mode).unwrap();
            states.features().unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        assert_eq!(features(&batch), features(&blind), "{kind:?}");
        // The shortcut that `measure` takes, which filters all images once, imagines the same.
        let posteriors = filtered(&agent.world, &batch, 12, &mut Sampler::Mode).unwrap();
        let after = imagined(&agent.world, &batch, &posteriors, 4, &mut Sampler::Mode).unwrap();
        let before = posteriors.map(|x| x.narrow(1, 0, 4)?.contiguous()).unwrap();
        let whole = joined(&before, &after).unwrap().features().unwrap();
        let (whole, expected) = (whole.flatten_all().unwrap().to_vec1::<f32>().unwrap(), features(&batch));
        assert!(whole.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-4), "{kind:?}");
    }
}

#[test]
fn measures_repeat_with_the_seed_and_drawn_latents_differ_from_the_mode() {
    let errors = |latents| -> Vec<_> {
        let measured = run(ModelKind::Rcwm, latents);
        assert_eq!((measured.imagined.len(), measured.posterior.len(), measured.films.len()), (12, 12, 1));
        assert_eq!(measured.imagined[0].of(Measure::RobotError).len(), 8);
        measured.imagined.iter().map(|trace| trace.mean(Measure::RobotError).unwrap()).collect()
    };
    assert_eq!(errors(Latents::Sample), errors(Latents::Sample));
    assert_ne!(errors(Latents::Sample), errors(Latents::Mode));
}

#[test]
fn the_errors_are_those_of_the_definition() {
    let (agent, task) = (agent(ModelKind::Rcwm), &tasks(5)[0]);
    let measured = run(ModelKind::Rcwm, Latents::Mode);
    let batch = task.batch(0, 10, &Device::Cpu).unwrap();
    let states = open_loop(&agent.world, &batch, 4, &mut Sampler::Mode).unwrap();
    let image = agent.world.decode(&states).unwrap().image;
    let truth = (batch.image.to_dtype(candle_core::DType::F32).unwrap() / 255.0).unwrap();
    let mask = batch.robot_mask.clone().unwrap().to_dtype(candle_core::DType::F32).unwrap();
    let ours = (image + 0.5).unwrap().broadcast_mul(&mask).unwrap();
    let error = (ours - truth.broadcast_mul(&mask).unwrap()).unwrap().sqr().unwrap();
    let error = error.flatten_from(2).unwrap().mean(2).unwrap().to_vec2::<f32>().unwrap(); // [B, T]
    for (trace, expected) in measured.imagined.iter().zip(error) {
        for (found, expected) in trace.of(Measure::RobotError).iter().zip(&expected[4..]) {
            assert!((found.unwrap() - f64::from(*expected)).abs() < 1e-5, "{found:?} {expected}");
        }
    }
}

#[test]
fn a_report_compares_models_on_the_same_trajectories() {
    let task = &tasks(5)[0];
    let (ours, theirs) = (run(ModelKind::Rcwm, Latents::Mode), run(ModelKind::Vanilla, Latents::Mode));
    let mut report = OpenLoopReport::new(settings(Latents::Mode));
    for (name, kind, measured) in [("rcwm", ModelKind::Rcwm, &ours), ("vanilla", ModelKind::Vanilla, &theirs)]
    {
        report.models.push(ModelReport {
            name: name.into(),
            checkpoint: "a test".into(),
            kind,
            preset: "debug".into(),
            updates: 0,
            tasks: vec![TaskReport::of(task, measured, 5)],
        });
    }
    let itself = Comparison::of(task, ("a", &ours), ("b", &ours), 5).unwrap();
    assert_eq!((itself.ratio, itself.interval.unwrap().low, itself.interval.unwrap().high), (1.0, 1.0, 1.0));
    let comparison = Comparison::of(task, ("vanilla", &theirs), ("rcwm", &ours), 5).unwrap();
    let mean = |model: usize| report.models[model].tasks[0].imagined[&Measure::RobotError].mean.unwrap();
    assert!((comparison.ratio - mean(1) / mean(0)).abs() < 1e-12);
    report.comparisons.push(comparison);
    let table = report.table();
    assert!(table.contains("robot error of vanilla is") && table.lines().count() == 6, "{table}");
    let series = &report.models[0].tasks[0].imagined[&Measure::MaskIou];
    assert_eq!(series.step_mean.len(), 8);
    let picture = report.plot(Measure::RobotError).unwrap();
    assert!(picture.width() > 300 && picture.height() > 200);
    assert!(serde_json::to_string(&report).unwrap().contains("robot_error_on_robot"));
}

#[test]
fn a_stopped_evaluation_says_so() {
    let stop = AtomicBool::new(true);
    let result =
        measure(&agent(ModelKind::Rcwm), &tasks(5)[0], &settings(Latents::Mode), &Device::Cpu, &stop, |_| ());
    assert!(matches!(result, Err(EvaluationError::Interrupted)));
}
