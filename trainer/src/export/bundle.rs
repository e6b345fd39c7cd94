//! The folder.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use ndarray::{ArrayD, IxDyn};
use rcwm_models::bundle::{
    Bundle, BundleKind, FORMAT, FileEntry, InitialState, MANIFEST_FILE, Manifest, PartEntry, PartName,
    PolicyInputs, Provenance,
};
use rcwm_models::files::{sha256_hex, write_atomic};
use rcwm_models::interface::Interface;
use rcwm_models::settings::ModelSettings;
use rcwm_models::tensors::{Tensors, Values};
use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::scene::Scene;
use super::weights::Weights;
use super::{ExportError, Progress, golden, part_to_onnx};
use crate::checkpoint::Checkpoint;
use crate::model::agent::Agent;
use crate::model::world::World;

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
    /// The parts; those of [`PartName::REQUIRED`] at least.
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
    let World::Rcwm(_) = agent.world else { return Err(ExportError::Vanilla) };
    let replaces = check_place(place, options.replace)?;
    let scene = match &options.golden_episode {
        Some(path) => Scene::from_episode(path, options.golden_ticks, settings)?,
        None => Scene::synthetic(options.golden_ticks, settings)?,
    };

    let parent = parent_of(place);
    fs::create_dir_all(parent).map_err(folder_error(parent))?;
    // Removed again if anything below fails.
    let building =
        tempfile::Builder::new().prefix(".exporting-").tempdir_in(parent).map_err(folder_error(parent))?;
    let folder = building.path();

    let weights = Weights::new(&checkpoint.parameters)?;
    let mut parts = Vec::with_capacity(options.parts.len());
    for (done, name) in options.parts.iter().enumerate() {
        progress.step(name.as_str(), done, options.parts.len())?;
        let file = write_file(folder, &format!("{name}.onnx"), &part_to_onnx(*name, &weights, settings))?;
        let (inputs, outputs) = name.signature(settings);
        let FileEntry { file, bytes, sha256 } = file;
        parts.push(PartEntry { name: *name, file, bytes, sha256, inputs, outputs });
    }
    let initial = initial_tensors(&golden::initial_state(&agent)?);
    let initial = write_file(folder, INITIAL_FILE, &initial.to_bytes()?)?;
    let golden = golden::record(&agent, &options.parts, &scene, options.golden_seed, progress)?;
    let golden = write_file(folder, GOLDEN_FILE, &golden.to_bytes()?)?;

    let manifest = Manifest {
        format: FORMAT,
        task: options.task.clone(),
        model: settings.clone(),
        kind: BundleKind::Rcwm,
        interface: options.interface.clone(),
        policy: PolicyInputs { inputs: inputs_of(&options.interface, settings), limits: None },
        provenance: provenance(checkpoint, options, &scene),
        initial,
        golden,
        parts,
    };
    write_file(folder, MANIFEST_FILE, toml::to_string(&manifest)?.as_bytes())?;
    Bundle::open(folder)?;
    progress.step("moving the bundle to its place", 1, 1)?;
    put_in_place(building, place, replaces)?;
    Ok(Bundle::open(place)?)
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

fn initial_tensors(initial: &InitialState) -> Tensors {
    let row = |len: usize| IxDyn(&[1, len]);
    let h = |values: &[f32]| Values::F32(ArrayD::from_shape_fn(row(values.len()), |index| values[index[1]]));
    let z = |values: &[i64]| Values::I64(ArrayD::from_shape_fn(row(values.len()), |index| values[index[1]]));
    let named = [
        ("robot/h", h(&initial.robot_h)),
        ("robot/z", z(&initial.robot_z)),
        ("environment/h", h(&initial.environment_h)),
        ("environment/z", z(&initial.environment_z)),
    ];
    Tensors(named.into_iter().map(|(name, values)| (name.to_owned(), values)).collect())
}

/// Writes a file of the bundle; each is on the disk before the folder gets its name.
fn write_file(folder: &Path, file: &str, bytes: &[u8]) -> Result<FileEntry, ExportError> {
    write_atomic(&folder.join(file), bytes)?;
    Ok(FileEntry { file: file.to_owned(), bytes: bytes.len() as u64, sha256: sha256_hex(bytes) })
}

/// Whether there is a bundle to replace.
fn check_place(place: &Path, replace: bool) -> Result<bool, ExportError> {
    let path = place.to_path_buf();
    match fs::symlink_metadata(place) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(source) => Err(ExportError::Folder { path, source }),
        Ok(_) if !place.join(MANIFEST_FILE).is_file() => Err(ExportError::NotABundle { path }),
        Ok(_) if !replace => Err(ExportError::Exists { path }),
        Ok(_) => Ok(true),
    }
}

/// Gives the finished folder its name in one step, so that whoever opens `place` sees the old bundle or the new one.
fn put_in_place(building: tempfile::TempDir, place: &Path, replaces: bool) -> Result<(), ExportError> {
    let flags = if replaces { RenameFlags::EXCHANGE } else { RenameFlags::NOREPLACE };
    make_readable(building.path()).map_err(folder_error(place))?;
    renameat_with(CWD, building.path(), CWD, place, flags)
        .map_err(|errno| folder_error(place)(errno.into()))?;
    let parent = parent_of(place);
    File::open(parent).and_then(|folder| folder.sync_all()).map_err(folder_error(parent))?;
    if replaces {
        // The temporary folder now holds the old bundle.
        building.close().map_err(folder_error(place))
    } else {
        let _moved = building.keep();
        Ok(())
    }
}

/// Temporary folders start private to their owner; a bundle is for everybody the place is for.
fn make_readable(folder: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(folder, fs::Permissions::from_mode(0o755))
}

fn parent_of(place: &Path) -> &Path {
    match place.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn folder_error(path: &Path) -> impl FnOnce(io::Error) -> ExportError {
    let path = path.to_path_buf();
    move |source| ExportError::Folder { path, source }
}
