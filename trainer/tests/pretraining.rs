//! A run of pre-training can be stopped, resumed and read at any time.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::Device;
use ndarray::{Array2, Array3, Array4};
use rcwm_gpu::{Machine, Precision};
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, Preset};
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::gpu::Share;
use rcwm_trainer::learning::LookSettings;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::replay::Replay;
use rcwm_trainer::training::{
    Compute, Line, Outcome, Pretraining, Progress, Run, TrainingError, TrainingSettings,
};

/// A bright square, the robot, that moves over a dark ground with the action.
fn episode(steps: usize, shift: usize, masked: bool) -> Episode {
    let inside = |t: usize, y: usize, x: usize| (8..24).contains(&y) && (x + 64 - (t + shift) % 64) % 64 < 16;
    Episode {
        image: Array4::from_shape_fn(
            (steps, 64, 64, 3),
            |(t, y, x, _)| if inside(t, y, x) { 220 } else { 30 },
        ),
        action: Array2::from_shape_fn((steps, 4), |(t, _)| if t == 0 { 0.0 } else { 0.5 }),
        disturbed: masked
            .then(|| Array4::from_shape_fn((steps, 64, 64, 3), |(t, y, _, c)| (t + 3 * y + 40 * c) as u8)),
        reward: (0..steps).map(|t| t as f32 * 0.1).collect(),
        robot_mask: masked.then(|| Array3::from_shape_fn((steps, 64, 64), |(t, y, x)| inside(t, y, x))),
        ..Episode::blank(steps)
    }
}

fn replay() -> Replay {
    let mut replay = Replay::new(1000);
    replay.add("reach", episode(20, 0, true)).unwrap();
    replay.add("reach", episode(15, 9, false)).unwrap();
    replay.add("hammer", episode(30, 30, true)).unwrap();
    replay
}

fn settings(kind: ModelKind, updates: u64) -> TrainingSettings {
    let mut settings = TrainingSettings::preset(Preset::Debug, kind, "memory".into());
    settings.pretrain.warm_up_updates = 4;
    settings.pretrain.updates = updates;
    settings.metrics_every = 2;
    settings.checkpoint_every = 5;
    settings.film.length = 0;
    settings
}

fn train(training: &mut Pretraining) -> Outcome {
    training.run(replay(), &AtomicBool::new(false), |_| ()).unwrap()
}

fn bits(parameters: &Parameters) -> Vec<(String, Vec<u32>)> {
    let bits = |var: &candle_core::Var| {
        var.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
    };
    parameters.iter().map(|(name, var)| (name.to_owned(), bits(var))).collect()
}

/// The lines of metrics: those of updates, or those on held-out episodes.
fn lines(folder: &Path, held_out: bool) -> Vec<serde_json::Value> {
    let text = fs::read_to_string(folder.join("metrics.jsonl")).unwrap();
    let lines = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    lines.filter(|line| line.get("held_out").is_some() == held_out).collect()
}

fn updates(lines: &[serde_json::Value]) -> Vec<u64> {
    lines.iter().map(|line| line["update"].as_u64().unwrap()).collect()
}

fn updates_logged(folder: &Path) -> Vec<u64> {
    updates(&lines(folder, false))
}

fn event_files(folder: &Path) -> usize {
    let name = |entry: fs::DirEntry| entry.file_name().to_string_lossy().into_owned();
    let names = fs::read_dir(folder).unwrap().map(|entry| name(entry.unwrap()));
    names.filter(|name| name.contains("tfevents")).count()
}

fn tensors() -> Compute {
    (&Device::Cpu).into()
}

fn programs() -> Compute {
    Compute::Programs(Share::alone(Machine::host()))
}

#[test]
fn a_resumed_run_gives_the_same_weights_as_one_that_never_stopped() {
    resumed_is_the_same_as_whole(tensors);
}

#[test]
fn a_resumed_run_of_programs_gives_the_same_weights_too() {
    resumed_is_the_same_as_whole(programs);
}

#[test]
fn a_resumed_run_on_a_gpu_gives_the_same_weights_too() {
    match Machine::nvidia(0, Precision::F32) {
        Ok(_) => resumed_is_the_same_as_whole(|| {
            Compute::Programs(Share::alone(Machine::nvidia(0, Precision::F32).unwrap()))
        }),
        Err(error) => eprintln!("not run: no GPU ({error})"),
    }
}

#[test]
fn programs_learn_what_tensors_learn() {
    programs_are_like_tensors(LookSettings::default());
}

#[test]
fn programs_see_the_scene_disturbed_as_tensors_do() {
    let plain = programs_are_like_tensors(LookSettings::default());
    let disturbed = programs_are_like_tensors(LookSettings { disturbed: 0.5, jitter: 0.0 });
    let coloured = programs_are_like_tensors(LookSettings { disturbed: 0.5, jitter: 0.5 });
    assert!(plain != disturbed && disturbed != coloured);
}

/// Trains both ways; the loss of the first updates.
fn programs_are_like_tensors(look: LookSettings) -> f64 {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, compute: Compute| {
        let mut settings = settings(ModelKind::Rcwm, 7);
        settings.replay.look = look;
        let mut training = Pretraining::create(&folder.path().join(name), settings, compute).unwrap();
        train(&mut training);
        (lines(&folder.path().join(name), false), lines(&folder.path().join(name), true))
    };
    let (tensors, programs) = (run("tensors", tensors()), run("programs", programs()));
    let pairs = tensors.0.iter().zip(&programs.0).chain(tensors.1.iter().zip(&programs.1));
    for (at, (expected, found)) in pairs.enumerate() {
        let total = |line: &serde_json::Value| {
            line.get("held_out").unwrap_or(&line["losses"])["total"].as_f64().unwrap()
        };
        let (expected, found) = (total(expected), total(found));
        // Later on, a draw may fall the other way: rounding differs.
        let tolerance = if at == 0 { 1e-4 } else { 1e-2 };
        assert!((found - expected).abs() <= tolerance * expected.abs(), "{found}, expected {expected}");
    }
    assert_eq!(tensors.0.len(), programs.0.len());
    programs.0[0]["losses"]["total"].as_f64().unwrap()
}

fn resumed_is_the_same_as_whole(compute: impl Fn() -> Compute) {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let folder = tempfile::tempdir().unwrap();
        let (whole, halves) = (folder.path().join("whole"), folder.path().join("halves"));
        let mut training = Pretraining::create(&whole, settings(kind, 12), compute()).unwrap();
        assert_eq!(train(&mut training), Outcome { updates: 12, interrupted: false });
        let expected = bits(training.parameters());

        let mut first = Pretraining::create(&halves, settings(kind, 6), compute()).unwrap();
        train(&mut first);
        assert_ne!(bits(first.parameters()), expected);
        drop(first);
        let mut second = Pretraining::resume(&halves, settings(kind, 12), compute()).unwrap();
        assert_eq!(second.updates(), 6);
        train(&mut second);
        assert!(bits(second.parameters()) == expected, "{kind:?}: not the same bits");
        assert_eq!(updates_logged(&halves), updates_logged(&whole));
        assert_eq!(updates(&lines(&whole, true)), [5, 10, 12]);
        let newest = |folder| lines(folder, true).last().unwrap()["held_out"].clone();
        assert_eq!(newest(&halves), newest(&whole), "the same weights are judged the same");
        assert_eq!((event_files(&whole), event_files(&halves)), (1, 2));
        let stored = |folder| bits(&Checkpoint::read(&Run::last(folder), &Device::Cpu).unwrap().parameters);
        assert!(stored(&halves) == stored(&whole), "{kind:?}: not the same average");
        assert!(stored(&halves) == bits(&second.ema_weights()) && stored(&halves) != expected);
    }
}

/// A run's weights, and what they give on held-out episodes.
type Learned = (Vec<(String, Vec<u32>)>, serde_json::Value);

/// Runs of these seeds, numbers of updates and folders, each in a thread of its own; what they have learned.
fn learn_together(runs: &[(u64, u64, &Path)], computes: Vec<Compute>) -> Vec<Learned> {
    std::thread::scope(|scope| {
        let thread = |(&(seed, updates, folder), compute): (&(u64, u64, &Path), Compute)| {
            let (folder, compute) = (folder.to_owned(), compute);
            scope.spawn(move || {
                let settings = TrainingSettings { seed, ..settings(ModelKind::Rcwm, updates) };
                let mut training = if folder.join("settings.toml").exists() {
                    Pretraining::resume(&folder, settings, compute).unwrap()
                } else {
                    Pretraining::create(&folder, settings, compute).unwrap()
                };
                train(&mut training);
                let newest = lines(&folder, true).last().unwrap()["held_out"].clone();
                (bits(training.parameters()), newest)
            })
        };
        let threads: Vec<_> = runs.iter().zip(computes).map(thread).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}

/// Three runs of which one is shorter, and one begins where it was stopped before: they ask for different updates at once.
fn alone_and_together(machine: impl Fn() -> Machine) -> [Vec<Learned>; 2] {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let runs = [(1, 12), (2, 7), (3, 12)];
    let alone = runs.map(|(seed, updates)| {
        let run = [(seed, updates, &*path(&format!("alone-{seed}")))];
        learn_together(&run, Compute::programs(machine())).remove(0)
    });
    learn_together(&[(3, 3, &path("together-3"))], Compute::programs(machine()));
    let folders = runs.map(|(seed, _)| path(&format!("together-{seed}")));
    let runs: Vec<_> =
        runs.iter().zip(&folders).map(|((seed, updates), folder)| (*seed, *updates, &**folder)).collect();
    let together = learn_together(&runs, Compute::programs(machine().for_runs(3)));
    [alone.to_vec(), together]
}

#[test]
fn runs_that_learn_together_learn_what_each_learns_alone() {
    let [alone, together] = alone_and_together(Machine::host);
    assert!(alone == together, "not the same bits");
    assert!(alone[0].0 != alone[2].0, "seeds differ");
}

#[test]
fn runs_that_learn_together_on_a_gpu_do_too() {
    match Machine::nvidia(0, Precision::F32) {
        Ok(_) => {
            // Other products are chosen for several runs: they may round otherwise.
            let [alone, together] = alone_and_together(|| Machine::nvidia(0, Precision::F32).unwrap());
            for ((_, alone), (_, together)) in alone.iter().zip(&together) {
                let total = |values: &serde_json::Value| values["total"].as_f64().unwrap();
                let (found, expected) = (total(together), total(alone));
                assert!((found - expected).abs() <= 1e-2 * expected, "{found}, expected {expected}");
            }
        }
        Err(error) => eprintln!("not run: no GPU ({error})"),
    }
}

#[test]
fn runs_of_other_settings_do_not_learn_together() {
    let folder = tempfile::tempdir().unwrap();
    let mut computes = Compute::programs(Machine::host().for_runs(2)).into_iter();
    let run = |name: &str, reward_scale: f64, compute: Compute| {
        let mut settings = settings(ModelKind::Rcwm, 2);
        settings.world.reward_scale = reward_scale;
        let mut training = Pretraining::create(&folder.path().join(name), settings, compute).unwrap();
        training.run(replay(), &AtomicBool::new(false), |_| ()).map(|outcome| outcome.updates)
    };
    std::thread::scope(|scope| {
        let (first, second) = (computes.next().unwrap(), computes.next().unwrap());
        let threads = [scope.spawn(|| run("first", 1.0, first)), scope.spawn(|| run("second", 2.0, second))];
        let results = threads.map(|thread| thread.join().unwrap());
        let refused: Vec<_> = results.iter().filter_map(|result| result.as_ref().err()).collect();
        assert_eq!(refused.len(), 1, "whoever comes first learns, alone");
        assert!(refused[0].to_string().contains("differ in more than their seed"), "{}", refused[0]);
    });
}

#[test]
fn without_an_average_a_checkpoint_holds_the_weights() {
    let folder = tempfile::tempdir().unwrap();
    let settings = TrainingSettings { average_decay: 0.0, ..settings(ModelKind::Rcwm, 6) };
    let mut training = Pretraining::create(folder.path(), settings, &Device::Cpu).unwrap();
    train(&mut training);
    let stored = Checkpoint::read(&Run::last(folder.path()), &Device::Cpu).unwrap();
    assert!(bits(&stored.parameters) == bits(training.parameters()));
    // Whoever wants an average from now on gets one that begins here.
    drop(training);
    let averaging = TrainingSettings { average_decay: 0.5, ..self::settings(ModelKind::Rcwm, 12) };
    let mut training = Pretraining::resume(folder.path(), averaging, &Device::Cpu).unwrap();
    train(&mut training);
    let stored = Checkpoint::read(&Run::last(folder.path()), &Device::Cpu).unwrap();
    assert!(bits(&stored.parameters) != bits(training.parameters()));
}

#[test]
fn a_run_that_died_after_a_checkpoint_repeats_what_was_lost() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, died) = (folder.path().join("whole"), folder.path().join("died"));
    let mut training = Pretraining::create(&whole, settings(ModelKind::Rcwm, 8), &Device::Cpu).unwrap();
    train(&mut training);
    let mut first = Pretraining::create(&died, settings(ModelKind::Rcwm, 5), &Device::Cpu).unwrap();
    train(&mut first);
    drop(first);
    // What a run that was killed two updates later leaves behind: metrics beyond the checkpoint, the last line cut off.
    let metrics = died.join("metrics.jsonl");
    let text = fs::read_to_string(&metrics).unwrap();
    fs::write(&metrics, format!("{text}{{\"update\":6,\"phase\":\"mask_free\"}}\n{{\"upda")).unwrap();
    let unfinished = Run::last(&died).join(".writing-abc");
    fs::write(&unfinished, "half a file").unwrap();
    let mut second = Pretraining::resume(&died, settings(ModelKind::Rcwm, 8), &Device::Cpu).unwrap();
    train(&mut second);
    assert!(bits(second.parameters()) == bits(training.parameters()));
    assert_eq!(updates_logged(&died), [2, 4, 6, 8]);
    assert!(!unfinished.exists());
}

#[test]
fn a_stopped_run_is_saved_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let mut settings = settings(ModelKind::Rcwm, 100);
    settings.film.length = 16;
    let mut training = Pretraining::create(folder.path(), settings, &Device::Cpu).unwrap();
    let stop = AtomicBool::new(false);
    let halt = |updates| stop.store(updates >= 7, Ordering::Relaxed);
    let outcome = training.run(replay(), &stop, |progress| halt(progress.updates)).unwrap();
    assert_eq!(outcome, Outcome { updates: 7, interrupted: true });
    let stored = Checkpoint::read(&Run::last(folder.path()), &Device::Cpu).unwrap();
    assert_eq!(stored.settings.updates, 7);
    assert!(folder.path().join("checkpoints/best/checkpoint.toml").exists());
    let files = fs::read_dir(Run::last(folder.path())).unwrap().count();
    for file in ["films/000007-reach.png", "films/hammer.gif", "curves.png"] {
        assert!(folder.path().join(file).exists(), "{file}");
    }
    assert_eq!(files, 3, "checkpoint.toml, one file of weights, one of the optimiser");
}

#[test]
fn masks_count_in_the_warm_up_only_and_losses_fall() {
    let folder = tempfile::tempdir().unwrap();
    let mut settings = settings(ModelKind::Rcwm, 40);
    settings.pretrain.warm_up_updates = 20;
    settings.world.adam.learning_rate = 1e-3;
    let mut training = Pretraining::create(folder.path(), settings, &Device::Cpu).unwrap();
    let mut lines = Vec::new();
    training.run(replay(), &AtomicBool::new(false), |progress| lines.extend(progress.line.cloned())).unwrap();
    assert_eq!(lines.len(), 20);
    assert!(lines.iter().all(|line| line.number("losses.robot_mask").is_some() == (line.phase == "warm_up")));
    let image = |line: &Line| line.number("losses.image").unwrap();
    assert!(image(&lines[19]) < 0.7 * image(&lines[0]), "{:?}", lines[19]);
}

#[test]
fn a_run_is_neither_overwritten_nor_resumed_where_there_is_none_or_with_another_model() {
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(Run::settings(folder.path()), Err(TrainingError::NothingToResume { .. })));
    let mut training =
        Pretraining::create(folder.path(), settings(ModelKind::Rcwm, 1), &Device::Cpu).unwrap();
    train(&mut training);
    let again = Pretraining::create(folder.path(), settings(ModelKind::Rcwm, 1), &Device::Cpu);
    assert!(matches!(again, Err(TrainingError::Exists { .. })));
    drop(training);
    let other = Pretraining::resume(folder.path(), settings(ModelKind::Vanilla, 1), &Device::Cpu);
    assert!(matches!(other, Err(TrainingError::OtherModel)));
}

#[test]
fn the_best_checkpoint_has_the_lowest_loss_on_episodes_that_are_not_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let mut settings = settings(ModelKind::Rcwm, 20);
    settings.world.adam.learning_rate = 1e-3;
    let mut training = Pretraining::create(folder.path(), settings.clone(), &Device::Cpu).unwrap();
    let mut seen = Vec::new();
    let show = |progress: &Progress<'_>| seen.extend(progress.held_out.cloned());
    training.run(replay(), &AtomicBool::new(false), show).unwrap();
    assert_eq!(seen.iter().map(|line| line.update).collect::<Vec<_>>(), [5, 10, 15, 20]);
    let best = seen.iter().min_by(|a, b| a.held_out.total.total_cmp(&b.held_out.total)).unwrap();
    assert!(best.best && best.held_out.total < seen[0].held_out.total);
    let stored = Checkpoint::read(&folder.path().join("checkpoints/best"), &Device::Cpu).unwrap();
    assert_eq!(stored.settings.updates, best.update);

    let without = folder.path().join("without");
    settings.replay.held_out_episodes = 0;
    let mut training = Pretraining::create(&without, settings, &Device::Cpu).unwrap();
    train(&mut training);
    assert!(lines(&without, true).is_empty());
    assert!(without.join("checkpoints/best/checkpoint.toml").exists(), "the training loss decides");
}
