//! The folder.

use std::path::{Path, PathBuf};

use ndarray::{ArrayD, IxDyn};
use rcwm_models::bundle::{
    Bundle, BundleError, BundleKind, FORMAT, FileEntry, InitialState, Manifest, NewBundle, PartEntry,
    PartName, PolicyInputs, Provenance, WriteError,
};
use rcwm_models::interface::Interface;
use rcwm_models::settings::ModelSettings;
use rcwm_models::tensors::{Tensors, Values};

use super::scene::Scene;
use super::weights::Weights;
use super::{ExportError, Progress, golden, part_to_onnx};
use crate::checkpoint::Checkpoint;
use crate::model::agent::Agent;

/// File name of the learned initial state.
const INITIAL_FILE: &str = "initial.safetensors";
/// File name of the golden values.
const GOLDEN_FILE: &str = "golden.safetensors";

/// What to export, and how.
#[derive(Debug, Clone)]
pub struct Options {
    /// Task the policy was made for, or `own`.
    pub task: String,
    /// The robot that the policy is for.
    pub interface: Interface,
    /// The parts; those of [`BundleKind::parts`] at least.
    pub parts: Vec<PartName>,
    /// Episode for the golden values; synthetic images without one.
    pub golden_episode: Option<PathBuf>,
    /// Ticks of golden values, at most.
    pub golden_ticks: usize,
    /// Seed of the golden noise.
    pub golden_seed: u64,
    /// Revision of the source, for the manifest.
    pub source_revision: String,
    /// Whether a bundle that is there is replaced.
    pub replace: bool,
}

/// Writes a bundle to `place` and gives it back as a runtime would read it.
///
/// # Errors
/// See [`ExportError`]; `place` is then as it was before.
pub fn write(
    checkpoint: &Checkpoint,
    place: &Path,
    options: &Options,
    progress: &dyn Progress,
) -> Result<Bundle, ExportError> {
    let settings = &checkpoint.settings.model;
    let agent = Agent::new(&checkpoint.parameters.frozen(), settings)?;
    let new = NewBundle::begin(place, options.replace)?;
    let scene = match &options.golden_episode {
        Some(path) => Scene::from_episode(path, options.golden_ticks, settings)?,
        None => Scene::synthetic(options.golden_ticks, settings)?,
    };

    let weights = Weights::new(&checkpoint.parameters)?;
    let mut parts = Vec::with_capacity(options.parts.len());
    let kind = BundleKind::of(settings.kind);
    if let Some(part) = options.parts.iter().find(|part| !kind.all_parts().any(|known| known == **part)) {
        return Err(WriteError::from(BundleError::OtherKind { part: *part, kind }).into());
    }
    for (done, name) in options.parts.iter().enumerate() {
        progress.step(name.as_str(), done, options.parts.len())?;
        let file = new.file(&format!("{name}.onnx"), &part_to_onnx(*name, &weights, settings))?;
        let (inputs, outputs) = name.signature(settings);
        let FileEntry { file, bytes, sha256 } = file;
        parts.push(PartEntry { name: *name, file, bytes, sha256, inputs, outputs });
    }
    let initial = initial_tensors(kind, &golden::initial_state(&agent)?);
    let initial = new.file(INITIAL_FILE, &initial.to_bytes()?)?;
    let golden = golden::record(&agent, &options.parts, &scene, options.golden_seed, progress)?;
    let golden = new.file(GOLDEN_FILE, &golden.to_bytes()?)?;

    let manifest = Manifest {
        format: FORMAT,
        task: options.task.clone(),
        model: Some(settings.clone()),
        kind,
        interface: options.interface.clone(),
        policy: PolicyInputs { inputs: inputs_of(&options.interface, settings), limits: None },
        provenance: provenance(checkpoint, options, &scene),
        initial,
        golden,
        parts,
    };
    new.check(&manifest)?;
    progress.step("moving the bundle to its place", 1, 1)?;
    Ok(new.finish()?)
}

/// What the policy reads: as many cameras as the model has, in the interface's order, and all states where it reads any.
fn inputs_of(interface: &Interface, model: &ModelSettings) -> Vec<String> {
    let cameras = interface.camera.iter().take(model.cameras).map(|camera| camera.name.clone());
    let states = interface.state.iter().filter(|_| model.state > 0).map(|state| state.name.clone());
    cameras.chain(states).collect()
}

fn provenance(checkpoint: &Checkpoint, options: &Options, scene: &Scene) -> Provenance {
    let settings = &checkpoint.settings;
    Provenance {
        preset: settings.preset.clone(),
        data: format!("weights: {}; golden values: {}", settings.data, scene.description),
        updates: settings.updates,
        seeds: vec![settings.seed, options.golden_seed],
        source_revision: options.source_revision.clone(),
    }
}

fn initial_tensors(kind: BundleKind, initial: &InitialState) -> Tensors {
    let row = |len: usize| IxDyn(&[1, len]);
    let h = |values: &[f32]| Values::F32(ArrayD::from_shape_fn(row(values.len()), |index| values[index[1]]));
    let z = |values: &[i64]| Values::I64(ArrayD::from_shape_fn(row(values.len()), |index| values[index[1]]));
    let named = kind.branches().iter().zip(&initial.branches).flat_map(|(branch, state)| {
        [(format!("{branch}/h"), h(&state.h)), (format!("{branch}/z"), z(&state.z))]
    });
    Tensors(named.collect())
}
