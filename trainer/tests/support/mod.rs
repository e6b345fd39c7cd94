//! What several tests need.

#![allow(dead_code, clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::path::PathBuf;

use candle_core::{Device, Tensor};
use ndarray::{Array1, Array2, Array4};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_trainer::checkpoint::{self, Checkpoint, CheckpointSettings};
use rcwm_trainer::model::agent;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::parity::Reference;
use rcwm_trainer::replay::Replay;

/// The authors' values, as committed.
pub fn reference_file() -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "..", "tests", "data", "rcwm-small.safetensors"].iter().collect()
}

/// The authors' weights as a checkpoint: all parameters far from where they start.
pub fn reference_checkpoint() -> Checkpoint {
    let reference = Reference::read(&reference_file()).unwrap();
    let device = Device::Cpu;
    let specs = agent::specs(&reference.settings).unwrap();
    let weights = reference.weights(&device).unwrap();
    let parameters = Parameters::from_tensors(&specs, weights, &device).unwrap();
    Checkpoint { settings: settings(reference.settings), parameters }
}

pub fn untrained(kind: ModelKind, seed: u64) -> Checkpoint {
    let model = ModelSettings::preset(Preset::Debug, kind);
    let parameters = agent::initialise(&model, seed, &Device::Cpu).unwrap();
    Checkpoint { settings: settings(model), parameters }
}

pub fn checkpoint(parameters: Parameters, model: ModelSettings) -> Checkpoint {
    Checkpoint { settings: settings(model), parameters }
}

fn settings(model: ModelSettings) -> CheckpointSettings {
    CheckpointSettings {
        format: checkpoint::FORMAT,
        preset: "custom".into(),
        seed: 0,
        updates: 0,
        data: "a test".into(),
        cpu_seconds: 0.0,
        weights_sha256: String::new(),
        model,
    }
}

/// Asserts that a square weight has the spread of a dense layer's start: `std = 1 / sqrt(width)`, cut at two of the uncut distribution.
pub fn assert_full_scale(name: &str, weight: &[f32]) {
    let std = (weight.len() as f64).powf(-0.25);
    let spread = (weight.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / weight.len() as f64).sqrt();
    assert!((0.8..1.2).contains(&(spread / std)), "{name}: spread {spread}, expected about {std}");
    assert!(weight.iter().all(|x| f64::from(x.abs()) <= 2.0 * std / 0.8796 + 1e-6), "{name}");
}

/// Parameters away from their start, where the layers that begin at 0 let gradients through.
pub fn lively_parameters(model: &ModelSettings) -> Parameters {
    let parameters = agent::initialise(model, 1, &Device::Cpu).unwrap();
    let mut generator = ChaCha8Rng::seed_from_u64(2);
    for (_, var) in parameters.iter() {
        let noise: Vec<f32> = (0..var.elem_count()).map(|_| generator.random_range(-0.05..0.05)).collect();
        let noise = Tensor::from_vec(noise, var.dims(), &Device::Cpu).unwrap();
        var.set(&(var.as_tensor() + noise).unwrap().detach()).unwrap();
    }
    parameters
}

/// A bright square that moves with the action, to and fro.
pub fn episode(steps: usize, shift: usize, success: bool) -> Episode {
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

pub fn replay() -> Replay {
    let mut replay = Replay::new(1000);
    for (steps, shift) in [(20, 0), (15, 9), (30, 30)] {
        replay.add("hammer", episode(steps, shift, true)).unwrap();
    }
    replay
}

pub type Bits = BTreeMap<String, Vec<u32>>;

pub fn bits(parameters: &Parameters) -> Bits {
    let bits = |var: &candle_core::Var| {
        var.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
    };
    parameters.iter().map(|(name, var)| (name.to_owned(), bits(var))).collect()
}

/// Names of the parameters that differ.
pub fn changed(before: &Bits, after: &Bits) -> Vec<String> {
    before.iter().filter(|(name, bits)| after[*name] != **bits).map(|(name, _)| name.clone()).collect()
}

/// A model whose every parameter is away from where it starts.
pub fn pretrained(kind: ModelKind) -> Checkpoint {
    let checkpoint = untrained(kind, 1);
    let mut generator = ChaCha8Rng::seed_from_u64(2);
    for (_, var) in checkpoint.parameters.iter() {
        let noise: Vec<f32> = (0..var.elem_count()).map(|_| generator.random_range(0.01..0.05)).collect();
        let noise = Tensor::from_vec(noise, var.dims(), &Device::Cpu).unwrap();
        var.set(&(var.as_tensor() + noise).unwrap().detach()).unwrap();
    }
    checkpoint
}
