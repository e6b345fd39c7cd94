use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor, Var};
use rcwm_models::files::{FileError, read_capped, write_atomic};
use rcwm_models::tensors::{Tensors, TensorsError};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::behaviour::ReturnRange;
use crate::learning::{Adam, AdamSettings, Moments};
use crate::model::parameters::{ParameterError, ParameterSpec, Parameters};

/// Key of [`TrainingState`] in the file's metadata.
const METADATA_KEY: &str = "training";
/// Under what the weights that are trained lie.
const TRAINED: &str = "trained";
/// Largest file accepted, in bytes: three times the largest file of weights.
const STATE_BYTES_MAX: u64 = 12 << 30;

/// Why the state of training could not be written or was refused.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// The file is missing, unreadable or too large.
    #[error("training state: {0}")]
    File(#[from] FileError),
    /// The folder could not be listed or cleaned.
    #[error("training state: {path}: {source}")]
    Folder { path: PathBuf, source: std::io::Error },
    /// It is no readable file of arrays.
    #[error("training state: {0}")]
    Tensors(#[from] TensorsError),
    /// It could not be put together.
    #[error("training state: {0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// Its counters are unreadable.
    #[error("training state: {0}")]
    Counters(#[from] serde_json::Error),
    /// Moments belong to no parameter, or have another shape.
    #[error(
        "training state: {name} {found:?} fits no parameter of this model; resume with the run's own settings"
    )]
    Unknown {
        /// The array.
        name: String,
        /// Its shape.
        found: Vec<usize>,
    },
    /// The weights that are trained do not fit the model.
    #[error("training state: {0}")]
    Parameters(#[from] ParameterError),
    /// A tensor operation failed.
    #[error("training state: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// What a checkpoint holds beside weights and optimisers.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingState {
    /// World-model updates made.
    pub updates: u64,
    /// Lowest mask-free loss over an interval between checkpoints; none before the first.
    pub best_loss: Option<f64>,
    /// Lowest loss on the held-out episodes; none before the first, or where none are held out.
    #[serde(default)]
    pub best_held_out_loss: Option<f64>,
    /// Highest success rate at a checkpoint of a run that acts; none before the first.
    #[serde(default)]
    pub best_success: Option<f64>,
    /// Steps that the policy has made.
    #[serde(default)]
    pub policy_steps: u64,
    /// Episodes that the policy has finished.
    #[serde(default)]
    pub episodes: u64,
    /// The returns' average range.
    pub return_range: ReturnRange,
    /// Steps of every parameter's optimiser, by optimiser and name.
    #[serde(rename = "steps")]
    pub optimiser_steps: BTreeMap<String, u64>,
}

/// The file that goes with these weights. Its name ties it to them: a checkpoint's settings name the weights, and whoever dies
/// while writing leaves the old pair or the new one.
fn file_of(folder: &Path, weights_sha256: &str) -> PathBuf {
    folder.join(format!("training-{}.safetensors", &weights_sha256[..16.min(weights_sha256.len())]))
}

impl TrainingState {
    /// Writes the state with the moments of `optimisers`, by name, beside the weights of this checksum, and the weights that are trained
    /// where the checkpoint holds their average.
    pub fn write(
        &self,
        optimisers: &[(&str, &Adam)],
        trained: Option<&Parameters>,
        folder: &Path,
        weights_sha256: &str,
    ) -> Result<(), StateError> {
        let mut state = self.clone();
        let mut arrays = BTreeMap::new();
        for (optimiser, adam) in optimisers {
            for (name, moments) in adam.moments() {
                let key = format!("{optimiser}/{name}");
                arrays.insert(format!("{key}/first"), bytes(&moments.first)?);
                arrays.insert(format!("{key}/second"), bytes(&moments.second)?);
                state.optimiser_steps.insert(key, moments.steps);
            }
        }
        for (name, var) in trained.into_iter().flat_map(Parameters::iter) {
            arrays.insert(format!("{TRAINED}/{name}"), bytes(var)?);
        }
        let views = arrays
            .iter()
            .map(|(name, (shape, bytes))| Ok((name, TensorView::new(Dtype::F32, shape.clone(), bytes)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
        let metadata = HashMap::from([(METADATA_KEY.to_owned(), serde_json::to_string(&state)?)]);
        let file = safetensors::serialize(views, Some(metadata))?;
        Ok(write_atomic(&file_of(folder, weights_sha256), &file)?)
    }

    /// Removes the states of other weights than these.
    ///
    /// # Errors
    /// [`StateError::Folder`].
    pub fn remove_others(folder: &Path, weights_sha256: &str) -> Result<(), StateError> {
        let keep = file_of(folder, weights_sha256);
        let clean = || {
            for entry in fs::read_dir(folder)? {
                let path = entry?.path();
                let name =
                    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
                if name.starts_with("training-") && name.ends_with(".safetensors") && path != keep {
                    fs::remove_file(path)?;
                }
            }
            Ok(())
        };
        clean().map_err(|source| StateError::Folder { path: folder.to_path_buf(), source })
    }

    /// Reads the state that goes with the weights of this checksum, and all moments under their keys.
    pub fn read(folder: &Path, weights_sha256: &str) -> Result<(Self, Tensors), StateError> {
        let file = read_capped(&file_of(folder, weights_sha256), STATE_BYTES_MAX)?;
        let (_, header) = SafeTensors::read_metadata(&file)?;
        let text = header.metadata().as_ref().and_then(|metadata| metadata.get(METADATA_KEY));
        let state = serde_json::from_str(text.map_or("", String::as_str))?;
        Ok((state, Tensors::from_bytes(&file)?))
    }

    /// The weights that are trained, of these names and shapes, where the checkpoint holds their average.
    ///
    /// # Errors
    /// [`StateError::Parameters`] if they do not fit, or those of [`Tensors`].
    pub fn trained(
        specs: &[ParameterSpec],
        tensors: &Tensors,
        device: &Device,
    ) -> Result<Option<Parameters>, StateError> {
        let mut found = BTreeMap::new();
        for ParameterSpec { name, .. } in specs {
            let key = format!("{TRAINED}/{name}");
            if let Ok(array) = tensors.f32(&key) {
                let tensor = Tensor::from_iter(array.iter().copied(), device)?.reshape(array.shape())?;
                found.insert(name.clone(), tensor);
            }
        }
        if found.is_empty() {
            return Ok(None);
        }
        Ok(Some(Parameters::from_tensors(specs, found, device)?))
    }

    /// The optimiser of this name as it was.
    ///
    /// # Errors
    /// [`StateError::Unknown`] if moments do not fit `parameters`, or those of [`Tensors`].
    pub fn optimiser(
        &self,
        optimiser: &str,
        settings: &AdamSettings,
        tensors: &Tensors,
        parameters: &Parameters,
    ) -> Result<Adam, StateError> {
        let mut moments = BTreeMap::new();
        for (key, steps) in &self.optimiser_steps {
            let Some(name) = key.strip_prefix(optimiser).and_then(|rest| rest.strip_prefix('/')) else {
                continue;
            };
            let load = |which: &str| {
                let array = tensors.f32(&format!("{key}/{which}"))?;
                match parameters.get(name) {
                    Some(parameter) if parameter.dims() == array.shape() => {
                        var(array, parameters.device()).map_err(StateError::from)
                    }
                    _ => Err(StateError::Unknown { name: key.clone(), found: array.shape().to_vec() }),
                }
            };
            let pair = Moments { first: load("first")?, second: load("second")?, steps: *steps };
            moments.insert(name.to_owned(), pair);
        }
        Ok(Adam::resumed(settings.clone(), moments))
    }
}

fn bytes(var: &Var) -> Result<(Vec<usize>, Vec<u8>), candle_core::Error> {
    let values = var.flatten_all()?.to_vec1::<f32>()?;
    Ok((var.dims().to_vec(), values.iter().flat_map(|value| value.to_le_bytes()).collect()))
}

fn var(array: &ndarray::ArrayD<f32>, device: &Device) -> Result<Var, candle_core::Error> {
    Var::from_tensor(&Tensor::from_iter(array.iter().copied(), device)?.reshape(array.shape())?)
}
