//! Open-loop evaluation of whole models on episodes that are made up.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use std::sync::atomic::AtomicBool;

use candle_core::Device;
use ndarray::{Array2, Array3, Array4};
use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelKind;
use rcwm_trainer::evaluation::{
    Answer, Comparison, EvaluationError, Latents, Measure, Measured, ModelReport, OTHER_KIND, OpenLoopReport,
    OpenLoopSettings, OtherActions, OverSeeds, Recordings, Response, TaskReport, TaskTrajectories, Trained,
    Windows, filtered, imagined, joined, measure, open_loop,
};
use rcwm_trainer::model::agent::Agent;
use rcwm_trainer::model::latent::Sampler;

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

fn recordings() -> Recordings {
    let mut recordings = Recordings::default();
    for shift in 0..5 {
        let kind = if shift < 2 { "expert" } else { OTHER_KIND };
        recordings.add("reach", kind, episode(20 + shift, 7 * shift, true)).unwrap();
    }
    recordings.add("reach", OTHER_KIND, episode(40, 3, false)).unwrap();
    recordings.add("reach", OTHER_KIND, episode(9, 3, true)).unwrap();
    recordings
}

fn agent(kind: ModelKind) -> Agent {
    let checkpoint = support::untrained(kind, 3);
    Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model).unwrap()
}

fn settings(latents: Latents) -> OpenLoopSettings {
    OpenLoopSettings {
        trajectories: 12,
        context: 4,
        imagined: 8,
        latents,
        seed: 5,
        films: 1,
        windows: Windows::Anywhere,
        other_actions: Some(OtherActions::Still),
    }
}

fn tasks(seed: u64) -> Vec<TaskTrajectories> {
    let settings = OpenLoopSettings { seed, ..settings(Latents::Sample) };
    TaskTrajectories::choose(&recordings(), &settings).unwrap()
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
    let settings = OpenLoopSettings { trajectories: 1000, ..settings(Latents::Sample) };
    let all = &TaskTrajectories::choose(&recordings(), &settings).unwrap()[0];
    assert_eq!(all.chosen.len(), (20..25).map(|steps| steps - 12 + 1).sum::<usize>());
}

#[test]
fn data_without_masks_or_too_short_is_one_clear_error() {
    let mut without = Recordings::default();
    without.add("reach", OTHER_KIND, episode(40, 0, false)).unwrap();
    let settings = settings(Latents::Sample);
    assert!(matches!(TaskTrajectories::choose(&without, &settings), Err(EvaluationError::NoMasks)));
    let short = TaskTrajectories::choose(&recordings(), &OpenLoopSettings { imagined: 60, ..settings });
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
            seed: 0,
            updates: 0,
            tasks: vec![TaskReport::of(task, measured, &settings(Latents::Mode))],
        });
    }
    let itself = Comparison::of(task, ("a", &ours), ("b", &ours), 5).unwrap();
    assert_eq!((itself.ratio, itself.interval.unwrap().low, itself.interval.unwrap().high), (1.0, 1.0, 1.0));
    let comparison = Comparison::of(task, ("vanilla", &theirs), ("rcwm", &ours), 5).unwrap();
    let mean = |model: usize| report.models[model].tasks[0].imagined[&Measure::RobotError].mean.unwrap();
    assert!((comparison.ratio - mean(1) / mean(0)).abs() < 1e-12);
    report.comparisons.push(comparison);
    let table = report.table();
    assert!(
        table.contains("robot error of vanilla is") && table.contains("over episodes of one training each")
    );
    for kind in ["all", "expert", OTHER_KIND] {
        let rows = table.lines().filter(|line| line.split_whitespace().nth(2) == Some(kind));
        assert_eq!(rows.count(), 2, "a row a model: {table}");
    }
    let kinds: Vec<_> =
        report.models[0].tasks[0].kinds.iter().map(|kind| (kind.kind.as_str(), kind.episodes)).collect();
    assert_eq!(kinds, [("expert", 2), (OTHER_KIND, 3)]);
    assert!(
        table.contains("recorded actions against the robot held still") && table.contains("over queries")
    );
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

/// A bar that the robot pushes goes where the actions say, so that other actions lead elsewhere; `seed` is the action's.
fn pushed(steps: usize, seed: usize) -> Episode {
    let place = |t: usize| 2 * ((t + seed) % 12);
    let robot = |t: usize, y: usize, x: usize| (8..16).contains(&y) && (place(t)..place(t) + 12).contains(&x);
    let object =
        |t: usize, y: usize, x: usize| (20..30).contains(&y) && (place(t)..place(t) + 12).contains(&x);
    Episode {
        image: Array4::from_shape_fn((steps, 64, 64, 3), |(t, y, x, _)| {
            match (robot(t, y, x), object(t, y, x)) {
                (true, _) => 220,
                (_, true) => 120,
                _ => 30,
            }
        }),
        action: Array2::from_shape_fn((steps, 4), |(t, i)| ((t * 5 + i + seed) % 9) as f32 / 4.5 - 1.0),
        robot_mask: Some(Array3::from_shape_fn((steps, 64, 64), |(t, y, x)| robot(t, y, x))),
        ..Episode::blank(steps)
    }
}

fn pushing() -> TaskTrajectories {
    let mut recordings = Recordings::default();
    (0..4).for_each(|seed| recordings.add("push", OTHER_KIND, pushed(30, seed)).unwrap());
    TaskTrajectories::choose(&recordings, &settings(Latents::Sample)).unwrap().remove(0)
}

/// What other actions change in what an RCWM with weights far from their start imagines, once `change` was made to it.
fn response(kind: ModelKind, change: impl Fn(&str) -> bool) -> Response {
    let mut checkpoint = support::untrained(kind, 3);
    checkpoint.parameters = support::lively_parameters(&checkpoint.settings.model);
    for (name, var) in checkpoint.parameters.iter() {
        if change(name) {
            var.set(&var.zeros_like().unwrap()).unwrap();
        }
    }
    let agent = Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model).unwrap();
    let (task, settings, stop) = (pushing(), settings(Latents::Sample), AtomicBool::new(false));
    let measured = measure(&agent, &task, &settings, &Device::Cpu, &stop, |_| ()).unwrap();
    assert_eq!(measured.response_films.len(), 1);
    TaskReport::of(&task, &measured, &settings).response.unwrap()
}

#[test]
fn an_environment_without_interaction_answers_no_other_actions_and_the_robot_does() {
    let living = response(ModelKind::Rcwm, |_| false);
    assert!(living.answers[&Answer::Environment].imagined > 1e-4, "{living:?}");
    let dead = response(ModelKind::Rcwm, |name| name.starts_with("interaction.output"));
    let (environment, robot) = (&dead.answers[&Answer::Environment], &dead.answers[&Answer::Robot]);
    assert_eq!((environment.share, environment.imagined), (Some(0.0), 0.0));
    assert_eq!(dead.answers[&Answer::Elsewhere].imagined, 0.0);
    assert!(environment.truth > 0.1 && robot.imagined > 1e-4, "{dead:?}");
    assert_eq!(
        robot.imagined,
        living.answers[&Answer::Robot].imagined,
        "the robot branch does not depend on it"
    );
}

#[test]
fn a_model_without_branches_answers_with_its_whole_picture() {
    let found = response(ModelKind::Vanilla, |_| false);
    assert_eq!(found.answers.keys().copied().collect::<Vec<_>>(), [Answer::Picture, Answer::PictureOnRobot]);
    assert!(found.answers[&Answer::Picture].share.is_some());
}

#[test]
fn errors_on_what_moves_are_those_of_the_true_pictures_pixels() {
    let (agent, task) = (agent(ModelKind::Rcwm), pushing());
    let (settings, stop) = (settings(Latents::Mode), AtomicBool::new(false));
    let measured = measure(&agent, &task, &settings, &Device::Cpu, &stop, |_| ()).unwrap();
    let batch = task.batch(0, 1, &Device::Cpu).unwrap();
    let states = open_loop(&agent.world, &batch, 4, &mut Sampler::Mode).unwrap();
    let found = agent.world.decode(&states).unwrap().image.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let chosen = &task.chosen[0];
    let frame = |t: usize| chosen.episode.image.index_axis(ndarray::Axis(0), chosen.start + t).to_owned();
    let (mut moving, mut pixels) = (0.0, 0);
    let (mut changed, mut still) = (0.0, 0.0);
    for t in 4..12 {
        let (before, now, seen) = (frame(t - 1), frame(t), frame(3));
        // Rows of the object; the robot lies elsewhere.
        for (y, x) in (20..30).flat_map(|y| (0..64).map(move |x| (y, x))) {
            let level = |picture: &Array3<u8>, c: usize| f64::from(picture[[y, x, c]]) / 255.0 - 0.5;
            let of = |c: usize| f64::from(found[((t * 64 + y) * 64 + x) * 3 + c]);
            let squares: f64 = (0..3).map(|c| (of(c) - level(&now, c)).powi(2)).sum();
            if before[[y, x, 0]] != now[[y, x, 0]] {
                moving += squares;
                pixels += 3;
            }
            if seen[[y, x, 0]] != now[[y, x, 0]] {
                changed += squares;
                still += (0..3).map(|c| (level(&seen, c) - level(&now, c)).powi(2)).sum::<f64>();
            }
        }
    }
    assert!(pixels > 100 && still > 0.0);
    let near = |measure: Measure, expected: f64| {
        let error = measured.imagined[0].mean(measure).unwrap();
        assert!((error - expected).abs() < 1e-5, "{measure:?}: {error}, expected {expected}");
    };
    near(Measure::MovingError, moving / f64::from(pixels));
    near(Measure::ChangeError, changed / still);
}

#[test]
fn attention_is_spread_in_an_rcwm_and_there_is_none_in_a_vanilla_model() {
    let spread = run(ModelKind::Rcwm, Latents::Mode).attention().unwrap();
    assert_eq!(spread.states, 12 * 8);
    assert!(
        spread.from_even > 1e-3 && spread.over_states > 1e-4 && spread.smallest < spread.even,
        "{spread:?}"
    );
    assert!(run(ModelKind::Vanilla, Latents::Mode).attention().is_none());
}

#[test]
fn models_of_several_seeds_are_compared_over_seeds_and_not_over_episodes() {
    let task = &tasks(5)[0];
    let all: Vec<_> = (0..6u64)
        .map(|number| {
            let kind = if number < 3 { ModelKind::Rcwm } else { ModelKind::Vanilla };
            let mut checkpoint = support::untrained(kind, number);
            checkpoint.settings.seed = number;
            let agent = Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model).unwrap();
            let (settings, stop) = (settings(Latents::Mode), AtomicBool::new(false));
            let measured = measure(&agent, task, &settings, &Device::Cpu, &stop, |_| ()).unwrap();
            (checkpoint.settings, vec![TaskReport::of(task, &measured, &settings)])
        })
        .collect();
    let trained: Vec<_> =
        all.iter().map(|(settings, tasks)| Trained { name: "a", settings, tasks }).collect();
    let mut report = OpenLoopReport::new(settings(Latents::Mode));
    report.over_seeds = OverSeeds::of(&trained, 0);
    let table = report.table();
    assert!(table.contains("reach: robot error of rcwm is"), "{table}");
    assert!(table.contains("times that of vanilla, over 3 and 3 training seeds; fewer than 5"), "{table}");
    let mean = |from: usize| {
        let of = |number: usize| all[number].1[0].imagined[&Measure::RobotError].mean.unwrap();
        (from..from + 3).map(of).sum::<f64>() / 3.0
    };
    assert!((report.over_seeds.comparisons[0].ratio - mean(0) / mean(3)).abs() < 1e-12);
}
