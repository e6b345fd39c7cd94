//! What several tests need.

#![allow(dead_code, clippy::unwrap_used)]

use std::path::PathBuf;

use candle_core::Device;
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_trainer::checkpoint::{self, Checkpoint, CheckpointSettings};
use rcwm_trainer::model::agent;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::parity::Reference;

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

/// An untrained checkpoint.
pub fn untrained(kind: ModelKind, seed: u64) -> Checkpoint {
    let model = ModelSettings::preset(Preset::Debug, kind);
    let parameters = agent::initialise(&model, seed, &Device::Cpu).unwrap();
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
