//! Updates as programs of kernels against the trainer's own: the kernels run on the host here, and on a GPU where there is one.

#![allow(clippy::unwrap_used)]

mod support;

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_gpu::learner::Images;
use rcwm_gpu::weights::Array;
use rcwm_gpu::{Machine, Precision};
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_models::{ACTION_LEN, IMAGE_BYTES, MASK_BYTES};
use rcwm_trainer::behaviour::{BehaviourLearner, BehaviourSettings, Horizon};
use rcwm_trainer::gpu::{GpuLearner, GpuPlan, Share, numbered_noise};
use rcwm_trainer::learning::{HostBatch, Trained, WorldLearner, WorldSettings, world_losses};
use rcwm_trainer::model::agent::{self, Agent};
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::parity::{self, Group};
use support::lively_parameters;

const SEED: u64 = 11;

fn batch(rows: usize, length: usize, masks: bool, number: u64) -> HostBatch {
    let mut generator = ChaCha8Rng::seed_from_u64(3 + number);
    let steps = rows * length;
    let mut bytes =
        |count: usize, most: u8| (0..count).map(|_| generator.random_range(0..=most)).collect::<Vec<u8>>();
    let image = bytes(steps * IMAGE_BYTES, 255);
    let robot_mask = if masks { bytes(steps * MASK_BYTES, 1) } else { Vec::new() };
    let mut first = vec![false; steps];
    first[0] = true;
    first[steps - 1] = true;
    first[steps / 2] = true;
    let mut terminal = vec![false; steps];
    terminal[1] = true;
    HostBatch {
        side: 64,
        rows,
        length,
        image,
        action: (0..steps * ACTION_LEN).map(|_| generator.random_range(-1.3..1.3)).collect(),
        reward: (0..steps).map(|_| generator.random_range(-2.0..9.0)).collect(),
        terminal,
        first,
        robot_mask,
        masks,
        pushed: vec![false; steps],
        number,
        ..HostBatch::default()
    }
}

fn plan<'a>(
    model: &'a ModelSettings,
    world: &'a WorldSettings,
    behaviour: Option<&'a BehaviourSettings>,
) -> GpuPlan<'a> {
    GpuPlan {
        model,
        batch: (ROWS, LENGTH),
        world,
        imitation: None,
        in_stages: false,
        behaviour,
        average_decay: 0.0,
        stored: &[],
        looks: false,
        mode: false,
    }
}

const ROWS: usize = 3;
const LENGTH: usize = 6;

/// Largest difference over the largest number.
fn difference(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(1e-6f32, |most, x| most.max(x.abs()));
    let worst = found
        .iter()
        .zip(expected)
        .fold(0f32, |most, (a, b)| if (a - b).is_nan() { f32::INFINITY } else { most.max((a - b).abs()) });
    worst / largest
}

fn numbers(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

fn close(what: &str, found: f64, expected: f64, tolerance: f64) {
    let error = (found - expected).abs() / expected.abs().max(1e-3);
    assert!(error <= tolerance, "{what}: {found}, expected {expected}");
}

/// Gradients on the machine by name.
fn gradients(learner: &mut GpuLearner) -> BTreeMap<String, Vec<f32>> {
    let learner = learner.learner_mut();
    let names: Vec<String> = learner.entries().iter().map(|entry| entry.name.clone()).collect();
    let gradient = |(at, name)| (name, learner.get(Array::Gradients, at).unwrap());
    names.into_iter().enumerate().map(gradient).collect()
}

fn compare(
    machine: Machine,
    preset: Preset,
    kind: ModelKind,
    masks: bool,
    decode_every: usize,
    tolerance: f32,
) {
    let model = ModelSettings::preset(preset, kind);
    let world = WorldSettings { decode_every, ..WorldSettings::default() };
    let behaviour = BehaviourSettings {
        horizon: Horizon { length: 4, ..Horizon::default() },
        ..BehaviourSettings::default()
    };
    let parameters = lively_parameters(&model);
    let copy = parameters.copied().unwrap();
    // Where not all steps are decoded, the encoders see other pictures, too.
    let looks = decode_every > 1;
    let plan = GpuPlan { looks, ..plan(&model, &world, Some(&behaviour)) };
    let mut gpu = GpuLearner::new(&Share::alone(machine), &plan, &copy).unwrap();
    let mut cpu = WorldLearner::new(&parameters, &model, &world, Trained::World).unwrap();
    let mut actor = BehaviourLearner::new(&parameters, &model, &behaviour).unwrap();
    for number in 0..3u64 {
        let mut host = batch(ROWS, LENGTH, masks, number);
        if looks {
            host.seen = host.image.iter().map(|x| 255 - x / 2).collect();
        }
        let found = gpu.update_world(&host, numbered_noise(SEED, number)).unwrap();
        let on_machine = gradients(&mut gpu);
        let mut sampler = Sampler::numbered(SEED, number);
        let tensors = host.into_tensors(&Device::Cpu).unwrap();
        let (losses, expected) = cpu.gradients(&tensors, &mut sampler).unwrap();
        let values = losses.values().unwrap();
        let tight = f64::from(tolerance);
        close("image", found.losses.image, values.image, tight);
        close("reward", found.losses.reward, values.reward, tight);
        close("continue", found.losses.continues, values.continues, tight);
        close("robot kl", found.losses.robot_kl, values.robot_kl, 10.0 * tight);
        close("total", found.losses.total, values.total, tight);
        if masks {
            close("mask", found.losses.robot_mask.unwrap(), values.robot_mask.unwrap(), tight);
        }
        close("norm", found.gradient_norm, expected.norm(), 10.0 * tight);
        let features = losses.observed.posteriors.features().unwrap(); // [B, T, state]
        let features = numbers(&features.transpose(0, 1).unwrap().contiguous().unwrap());
        let error = difference(&gpu.learner_mut().features().unwrap(), &features);
        assert!(error <= tolerance, "features: {error:e}");
        let mut worst = (0.0, String::new());
        for (name, gradient) in expected.iter() {
            if name == "interaction.key.bias" {
                continue; // truly 0: rounding alone
            }
            let error = difference(&on_machine[name], &numbers(gradient));
            if error >= worst.0 {
                worst = (error, name.to_owned());
            }
        }
        eprintln!("{kind:?} masks {masks} update {number}: worst gradient {:e} {}", worst.0, worst.1);
        assert!(worst.0 <= 20.0 * tolerance, "gradient of {}: {:e}", worst.1, worst.0);
        cpu.apply(&expected).unwrap();

        let start = losses.observed.posteriors.map(|x| x.flatten(0, 1)).unwrap().detached();
        actor.mix_slow_critic().unwrap();
        let imagined = actor.imagine_shares(&start, &mut sampler).unwrap();
        let expected = actor.gradients(imagined).unwrap();
        let (found, _) = gpu.update_behaviour().unwrap();
        let on_machine = gradients(&mut gpu);
        let values = expected.values;
        close("actor loss", found.actor_loss, values.actor_loss, 30.0 * tight);
        close("critic loss", found.critic_loss, values.critic_loss, 10.0 * tight);
        close("entropy", found.entropy, values.entropy, 10.0 * tight);
        close("imagined reward", found.reward, values.reward, 30.0 * tight);
        close("return", found.lambda_return, values.lambda_return, 30.0 * tight);
        close("value", found.value, values.value, 30.0 * tight);
        close("scale", found.return_scale, values.return_scale, 30.0 * tight);
        for (name, gradient) in expected.actor.iter().chain(expected.critic.iter()) {
            let error = difference(&on_machine[name], &numbers(gradient));
            assert!(error <= 100.0 * tolerance, "gradient of {name}: {error:e}");
        }
        actor.apply(&expected).unwrap();
    }
    gpu.write_back(Array::Values, &copy).unwrap();
    for (name, var) in parameters.iter() {
        let error =
            difference(&numbers(&copy.get(name).unwrap().as_detached_tensor()), &numbers(var.as_tensor()));
        assert!(error <= 1e-2, "{name} after three updates: {error:e}");
    }
}

#[test]
fn programs_of_kernels_give_the_losses_gradients_and_weights_of_the_trainers_own_updates() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        for (masks, decode_every) in [(true, 1), (false, 3)] {
            compare(Machine::host(), Preset::Debug, kind, masks, decode_every, 1e-4);
        }
    }
}

/// Gradients of an update on the host, by name, and how many commands it had.
fn gradients_on(machine: Machine, kind: ModelKind) -> (BTreeMap<String, Vec<f32>>, usize) {
    let model = ModelSettings::preset(Preset::Debug, kind);
    let world = WorldSettings { decode_every: 1, ..WorldSettings::default() };
    let parameters = lively_parameters(&model);
    let mut gpu = GpuLearner::new(&Share::alone(machine), &plan(&model, &world, None), &parameters).unwrap();
    gpu.update_world(&batch(ROWS, LENGTH, true, 0), numbered_noise(SEED, 0)).unwrap();
    let commands = gpu.learner_mut().commands().0;
    (gradients(&mut gpu), commands)
}

#[test]
fn what_lanes_compute_does_not_depend_on_how_they_meet() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let (found, _) = gradients_on(Machine::host(), kind);
        let (late, _) = gradients_on(Machine::host_with_side_late(), kind);
        assert_eq!(found, late);
    }
}

#[test]
fn validation_is_of_the_average_that_a_checkpoint_holds() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let world = WorldSettings::default();
    let weights = lively_parameters(&model);
    let plan = GpuPlan { average_decay: 0.9, ..plan(&model, &world, None) };
    let mut gpu = GpuLearner::new(&Share::alone(Machine::host()), &plan, &weights).unwrap();
    for number in 0..4 {
        gpu.update_world(&batch(ROWS, LENGTH, false, number), numbered_noise(SEED, number)).unwrap();
    }
    let host = batch(ROWS, LENGTH, false, 9);
    let found = gpu.validate_world(&host, Images::Host(&host.image, &[]), numbered_noise(SEED, 9)).unwrap();
    let tensors = host.clone().into_tensors(&Device::Cpu).unwrap();
    let mut total_of = |array: Array| {
        gpu.write_back(array, &weights).unwrap();
        let agent = Agent::new(&weights.frozen(), &model).unwrap();
        let mut sampler = Sampler::numbered(SEED, 9);
        world_losses(&agent, &tensors, &world, &mut sampler).unwrap().values().unwrap().total
    };
    let (of_average, of_values) = (total_of(Array::Average), total_of(Array::Values));
    close("total", found.total, of_average, 1e-5);
    assert!(
        (of_values - of_average).abs() > 1e-4 * of_average,
        "{of_values} and {of_average} are too alike to tell"
    );
}

#[test]
fn sizes_that_kernels_do_not_take_are_refused_by_name() {
    let debug = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    for (model, name) in [
        (ModelSettings { cnn_depth: 6, ..debug.clone() }, "cnn_depth = 6"),
        (ModelSettings { image_side: 128, ..debug.clone() }, "image_side = 128"),
        (ModelSettings { cameras: 2, ..debug.clone() }, "cameras = 2"),
        (ModelSettings { state: 14, ..debug }, "state = 14"),
    ] {
        let weights = agent::initialise(&model, 1, &Device::Cpu).unwrap();
        let world = WorldSettings::default();
        let refused = GpuLearner::new(&Share::alone(Machine::host()), &plan(&model, &world, None), &weights);
        let text = refused.unwrap_err().to_string();
        assert!(text.contains(name) && text.lines().count() == 1, "{text}");
    }
}

#[test]
fn programs_give_the_authors_numbers() {
    let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/rcwm-small.safetensors");
    let report =
        parity::check_programs(&file, &Group::ALL, &Share::alone(Machine::host()), &mut |_| ()).unwrap();
    assert_eq!(report.groups.len(), 6);
    for group in &report.groups {
        assert!(group.passes(), "{}: {:?}", group.group.as_str(), group.worst());
    }
}

#[test]
fn a_gpu_gives_what_the_host_gives() {
    let machine = match Machine::nvidia(0, Precision::F32) {
        Ok(machine) => machine,
        Err(error) => {
            eprintln!("not run: no GPU ({error})");
            return;
        }
    };
    drop(machine);
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        for (masks, decode_every) in [(true, 1), (false, 3)] {
            let machine = Machine::nvidia(0, Precision::F32).unwrap();
            compare(machine, Preset::Debug, kind, masks, decode_every, 1e-4);
        }
        // The paper's sizes, too.
        let machine = Machine::nvidia(0, Precision::F32).unwrap();
        compare(machine, Preset::Paper, kind, true, 1, 1e-4);
    }
}
