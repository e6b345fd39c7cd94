//! Acting and learning at the same time, in simulators of the test's own at the other end of the real link.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use candle_core::{Device, Tensor};
use ndarray::{Array1, Array2, Array4};
use rcwm_gpu::Machine;
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, Preset};
use rcwm_models::wire::{ActionValues, Format, LinkSettings, ObservationFlags, SimulatorLink, Wait};
use rcwm_trainer::acting::{Policy, PolicyInput, filter_step};
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::gpu::Share;
use rcwm_trainer::model::agent::Agent;
use rcwm_trainer::model::latent::{FirstSteps, Sampler};
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::replay::Folder;
use rcwm_trainer::training::{
    Compute, Finetuning, OnlineOutcome, Phase, Run, TrainingError, TrainingSettings, episodes_folder,
};

const EPISODE_STEPS: u32 = 6;

fn pixel(step: usize, at: usize) -> u8 {
    ((step * 31 + at / 3 * 7) % 251) as u8
}

/// A recorded episode.
fn episode(steps: usize, success: bool) -> Episode {
    Episode {
        image: Array4::from_shape_fn((steps, 64, 64, 3), |(t, y, x, c)| pixel(t, (y * 64 + x) * 3 + c)),
        action: Array2::from_shape_fn((steps, 4), |(t, _)| if t == 0 { 0.0 } else { 0.25 }),
        reward: (0..steps).map(|t| t as f32 * 0.1).collect(),
        success: Array1::from_elem(steps, success),
        ..Episode::blank(steps)
    }
}

/// A simulator in lock-step, which solves its task in every other episode.
struct Simulator {
    instance: String,
    stop: Arc<AtomicBool>,
    /// The actions it executed, episode by episode.
    thread: Option<JoinHandle<Vec<Vec<[f32; 4]>>>>,
}

impl Simulator {
    fn start(episodes: u64) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let instance = format!("online-{}-{number}", std::process::id());
        let stop = Arc::new(AtomicBool::new(false));
        let (name, heard) = (instance.clone(), Arc::clone(&stop));
        let thread = std::thread::spawn(move || serve(&name, episodes, &heard));
        Self { instance, stop, thread: Some(thread) }
    }

    fn executed(mut self) -> Vec<Vec<[f32; 4]>> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap()
    }
}

fn serve(instance: &str, episodes: u64, stop: &AtomicBool) -> Vec<Vec<[f32; 4]>> {
    let link = SimulatorLink::open(LinkSettings::new(instance), &Format::metaworld()).unwrap();
    let (mut sequence, mut all) = (0, Vec::new());
    for episode in 0..episodes {
        let (mut executed, mut done) = (ActionValues::zeros(4), Vec::new());
        for step in 0..=EPISODE_STEPS {
            let publish = || {
                link.publish(|observation| {
                    observation.sequence = sequence;
                    observation.episode = episode;
                    observation.step = step;
                    observation.reward = step as f32;
                    observation.executed().copy_from_slice(&executed);
                    for (at, value) in observation.image(0).iter_mut().enumerate() {
                        *value = pixel(step as usize, at);
                    }
                    observation.flags = ObservationFlags::default()
                        .with(ObservationFlags::FIRST, step == 0)
                        .with(ObservationFlags::LAST, step == EPISODE_STEPS)
                        .with(ObservationFlags::SUCCESS, step == 3 && episode % 2 == 0)
                        .0;
                })
                .unwrap();
            };
            publish();
            let answer = loop {
                if stop.load(Ordering::Relaxed) {
                    return all;
                }
                match link.wait_action(Duration::from_millis(20)).unwrap() {
                    (Wait::Message(action), _) if action.answers == sequence => break action.action,
                    (_, events) if events.hello => publish(),
                    _ => {}
                }
            };
            sequence += 1;
            if step < EPISODE_STEPS {
                executed = answer;
                done.push(<[f32; 4]>::try_from(&*answer).unwrap());
            }
        }
        all.push(done);
    }
    link.close().unwrap();
    all
}

fn settings(kind: ModelKind, data: &Path) -> TrainingSettings {
    let mut settings = TrainingSettings::preset(Preset::Debug, kind, data.to_path_buf());
    settings.phase = Phase::Train;
    settings.task = "hammer".into();
    settings.metrics_every = 2;
    settings.checkpoint_every = 5;
    settings.behaviour.horizon.length = 3;
    settings.finetune.simulators = 0;
    settings.finetune.warm_up_updates = 3;
    settings.finetune.steps = 40;
    settings.finetune.train_ratio = 4.0;
    settings.finetune.success_episodes = 4;
    settings
}

fn data(folder: &Path) {
    fs::create_dir_all(folder.join("hammer")).unwrap();
    for (name, steps, success) in [("a", 9, true), ("b", 12, false), ("c", 9, true), ("d", 50, false)] {
        episode(steps, success).write(&folder.join("hammer").join(name).with_extension("npz")).unwrap();
    }
}

fn run(training: &mut Finetuning, join: &[&Simulator]) -> Result<OnlineOutcome, TrainingError> {
    let stop = AtomicBool::new(false);
    let filled = training.prefill(&stop, &|_| ())?;
    let instances: Vec<_> = join.iter().map(|simulator| simulator.instance.clone()).collect();
    training.run(filled, &instances, &stop, |_| ())
}

fn bits(parameters: &Parameters) -> Vec<(String, Vec<u32>)> {
    let bits = |var: &candle_core::Var| {
        var.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
    };
    parameters.iter().map(|(name, var)| (name.to_owned(), bits(var))).collect()
}

fn lines(folder: &Path) -> Vec<serde_json::Value> {
    let text = fs::read_to_string(folder.join("metrics.jsonl")).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn the_policy_acts_in_all_simulators_and_learns_as_the_ratio_says() {
    let cases = [
        (ModelKind::Rcwm, Compute::from(&Device::Cpu)),
        (ModelKind::Vanilla, Compute::from(&Device::Cpu)),
        (ModelKind::Rcwm, Compute::Programs(Share::alone(Machine::host()))),
    ];
    for (kind, compute) in cases {
        let folder = tempfile::tempdir().unwrap();
        let (home, out) = (folder.path().join("data"), folder.path().join("run"));
        data(&home);
        let settings = settings(kind, &home);
        let simulators = [Simulator::start(1000), Simulator::start(1000)];
        let mut training = Finetuning::create(&out, settings.clone(), None, compute).unwrap();
        let outcome = run(&mut training, &[&simulators[0], &simulators[1]]).unwrap();
        // Two decisions a round: the round in which step 40 is reached is the last.
        assert_eq!(outcome.policy_steps, 40);
        let batch_steps = settings.replay.batch * settings.replay.length;
        assert_eq!(outcome.updates, 3 + 40 * 4 / batch_steps as u64);
        assert!(!outcome.interrupted && outcome.refused_actions == 0);
        assert_eq!(outcome.episodes, 6, "both have made three episodes of six steps");
        assert_eq!(outcome.success_rate, Some(0.5), "the newest four: one solved each");

        let told: Vec<_> = lines(&out).into_iter().filter(|line| !line["episode"].is_null()).collect();
        assert_eq!(told.len(), 6);
        for line in &told {
            assert_eq!((&line["episode"]["return"], &line["episode"]["steps"]), (&21.0.into(), &6.into()));
        }
        let executed: Vec<_> = simulators.into_iter().map(Simulator::executed).collect();
        let mut recorded = 0;
        for read in Folder::list(&episodes_folder(&out).join("hammer"), None).unwrap().episodes() {
            let (_, path, episode) = read.unwrap();
            let actions: Vec<[f32; 4]> =
                (1..episode.len()).map(|t| std::array::from_fn(|i| episode.action[[t, i]])).collect();
            assert!(executed.iter().flatten().any(|done| *done == actions), "{}", path.display());
            assert!(actions.iter().flatten().all(|x| x.is_finite() && x.abs() <= 1.0));
            recorded += 1;
        }
        assert_eq!(recorded, 6);
    }
}

#[test]
fn a_resumed_run_has_its_weights_counters_and_replay_back() {
    resumed_has_everything_back(|| (&Device::Cpu).into());
}

#[test]
fn a_resumed_run_of_programs_has_them_back_too() {
    resumed_has_everything_back(|| Compute::Programs(Share::alone(Machine::host())));
}

fn resumed_has_everything_back(compute: impl Fn() -> Compute) {
    let folder = tempfile::tempdir().unwrap();
    let (home, out) = (folder.path().join("data"), folder.path().join("run"));
    data(&home);
    let settings = settings(ModelKind::Rcwm, &home);
    let simulator = Simulator::start(3);
    let mut training = Finetuning::create(&out, settings.clone(), None, compute()).unwrap();
    let outcome = run(&mut training, &[&simulator]).unwrap();
    assert!(outcome.interrupted, "the only simulator has ended after three episodes");
    assert_eq!((outcome.policy_steps, outcome.episodes), (18, 3));
    let (before, state) = (bits(training.parameters()), training.state().clone());
    drop(training);

    let mut training = Finetuning::resume(&out, Run::settings(&out).unwrap(), compute()).unwrap();
    assert!(bits(training.parameters()) == before);
    assert_eq!((training.state().policy_steps, training.state().episodes), (18, 3));
    assert_eq!(training.state().updates, state.updates);
    let filled = training.prefill(&AtomicBool::new(false), &|_| ()).unwrap();
    assert_eq!(filled.policy_successes, [true, false, true]);
    assert_eq!(filled.replay.episodes(), 3 + 3);
    assert_eq!(filled.demonstrations, 1, "one is wanted: the second success is left out");
    let simulator = Simulator::start(1000);
    let outcome = run(&mut training, &[&simulator]).unwrap();
    assert_eq!((outcome.policy_steps, outcome.interrupted), (40, false));
    assert!(outcome.updates > state.updates && outcome.episodes > 3);
}

#[test]
fn fine_tuning_starts_from_the_model_it_is_given() {
    let folder = tempfile::tempdir().unwrap();
    let (home, out) = (folder.path().join("data"), folder.path().join("run"));
    data(&home);
    let source: Checkpoint = support::untrained(ModelKind::Rcwm, 11);
    let mut settings = settings(ModelKind::Rcwm, &home);
    settings.phase = Phase::Finetune;
    let training = Finetuning::create(&out, settings.clone(), Some(&source), &Device::Cpu).unwrap();
    let own = bits(training.parameters());
    for (name, bits) in bits(&source.parameters) {
        let same = own.iter().any(|(other, value)| *other == name && *value == bits);
        let kept = ["encoder", "decoder", "robot"].iter().any(|part| name.starts_with(part));
        assert!(!kept || same, "{name} is kept");
    }
    let wrong = settings_of_another_kind(&settings);
    let refused = Finetuning::resume(&out, wrong, &Device::Cpu);
    assert!(matches!(refused, Err(TrainingError::OtherPhase { found: "fewshot", .. })));
}

fn settings_of_another_kind(settings: &TrainingSettings) -> TrainingSettings {
    TrainingSettings { phase: Phase::Fewshot, ..settings.clone() }
}

#[test]
fn one_filter_step_after_another_is_the_filter() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let checkpoint = support::untrained(kind, 5);
        let agent = Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model).unwrap();
        let (rows, length) = (2, 5);
        let bytes: Vec<u8> = (0..rows * length * 64 * 64 * 3).map(|at| pixel(at / 12288, at)).collect();
        let images = Tensor::from_vec(bytes, (rows, length, 64, 64, 3), &Device::Cpu).unwrap();
        let actions: Vec<f32> = (0..rows * length * 4).map(|at| (at % 7) as f32 / 3.0 - 1.0).collect();
        let actions = Tensor::from_vec(actions, (rows, length, 4), &Device::Cpu).unwrap();
        let first = FirstSteps::new((0..rows * length).map(|at| at % length == 0).collect(), length);
        let embeds = agent.world.encode(&images, None).unwrap();
        let whole = agent.world.observe(&embeds, &actions, &first, &mut Sampler::Mode).unwrap().posteriors;
        let whole = whole.features().unwrap();
        let mut state = agent.world.initial(rows).unwrap();
        for t in 0..length {
            let at = |x: &Tensor| x.narrow(1, t, 1).unwrap().squeeze(1).unwrap().contiguous().unwrap();
            // No action led to the first image.
            let action = if t == 0 { at(&actions).zeros_like().unwrap() } else { at(&actions) };
            state = filter_step(&agent.world, &state, &at(&images), &action, &mut Sampler::Mode).unwrap();
            let error = (state.features().unwrap() - at(&whole)).unwrap().abs().unwrap();
            let error = error.flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap();
            assert!(error < 1e-5, "{kind:?}, step {t}: {error}");
        }
    }
}

#[test]
fn a_policy_that_is_not_finite_sends_zeros_and_says_so() {
    let checkpoint = support::untrained(ModelKind::Rcwm, 5);
    let agent = Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model).unwrap();
    let mut policy = Policy::new(agent, 2, &Device::Cpu);
    let image = vec![90; 64 * 64 * 3];
    let seen = [0, 1].map(|simulator| PolicyInput {
        simulator,
        first: true,
        image: &image,
        executed: [0.0; 4].into(),
    });
    let good = policy.decide(&seen, &mut Sampler::seeded(1)).unwrap();
    assert!(good.iter().all(|decision| !decision.refused && decision.action != [0.0; 4]));
    let poisoned = checkpoint.parameters.get("actor.out.bias").unwrap();
    poisoned.set(&(poisoned.as_tensor() * f64::NAN).unwrap().detach()).unwrap();
    let bad = policy.decide(&seen, &mut Sampler::seeded(1)).unwrap();
    assert!(bad.iter().all(|decision| decision.refused && decision.action == [0.0; 4]));
}

#[test]
fn a_model_that_went_wrong_stops_the_run_and_is_not_saved() {
    let folder = tempfile::tempdir().unwrap();
    let (home, out) = (folder.path().join("data"), folder.path().join("run"));
    data(&home);
    let mut settings = settings(ModelKind::Rcwm, &home);
    settings.finetune.train_ratio = 0.0;
    let simulator = Simulator::start(1000);
    let mut training = Finetuning::create(&out, settings, None, &Device::Cpu).unwrap();
    let actor = training.parameters().get("actor.out.weight").unwrap().clone();
    actor.set(&(actor.as_tensor() * f64::INFINITY).unwrap().detach()).unwrap();
    let error = run(&mut training, &[&simulator]).unwrap_err();
    assert!(error.to_string().contains("actor.out.weight"), "{error}");
    assert!(!Run::has_checkpoint(&out));
    assert!(simulator.executed().iter().flatten().flatten().all(|x| x.is_finite()));
}
