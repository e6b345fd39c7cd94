//! A checkpoint: a folder with the weights and the settings they were made with.
//!
//! ```text
//! checkpoint.toml               format, sizes, preset, seed, updates, sha256 of the weights
//! weights-<sha256>.safetensors  every parameter by name, f32, or f16 where that loses nothing ([`Checkpoint::rounded`]); the name
//!                               holds the checksum's first 16 digits
//! ```
//!
//! Both files are written whole or not at all, the settings last, and only then are older weights removed: whenever the writer
//! dies, the folder holds a whole checkpoint, the old one or the new one.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use rcwm_models::files::{FileError, read_capped, sha256_hex, write_atomic};
use rcwm_models::settings::{ModelSettings, SettingsError};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::model::agent;
use crate::model::parameters::{ParameterError, Parameters};

/// File name of the settings.
pub const SETTINGS_FILE: &str = "checkpoint.toml";
/// Version of the checkpoint format.
pub const FORMAT: u32 = 1;
/// Largest file of weights accepted, in bytes; the paper's has about 100 MB.
const WEIGHTS_BYTES_MAX: u64 = 4 << 30;

/// Why a checkpoint could not be written or was refused.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file is missing, unreadable, too large or a link.
    #[error("checkpoint: {0}")]
    File(#[from] FileError),
    /// The folder could not be made.
    #[error("checkpoint: {path}: {source}")]
    Folder { path: PathBuf, source: std::io::Error },
    /// The folder holds a checkpoint already.
    #[error("checkpoint: {path} holds a checkpoint already; choose another folder or say --force")]
    Exists { path: PathBuf },
    /// There is none at the path, and none of a run either.
    #[error("checkpoint: {path}: {reason}")]
    NoCheckpoint {
        path: PathBuf,
        /// What is there, and what was expected.
        reason: String,
    },
    /// The settings are unusable.
    #[error("checkpoint: {0}")]
    Settings(#[from] SettingsError),
    /// The settings could not be written as TOML.
    #[error("checkpoint: {0}")]
    Serialize(#[from] toml::ser::Error),
    /// It was written by another version.
    #[error("checkpoint: format {found}, this program reads format {FORMAT}; use the trainer that wrote it")]
    Format {
        /// The format found.
        found: u32,
    },
    /// The weights are not those that were written with the settings.
    #[error("checkpoint: {file} has sha256 {found}, {SETTINGS_FILE} says {expected}; use another checkpoint")]
    Checksum {
        /// The weights.
        file: String,
        /// The checksum found.
        found: String,
        /// The checksum expected.
        expected: String,
    },
    /// The settings' checksum is none.
    #[error("checkpoint: {SETTINGS_FILE}: weights_sha256 = {found:?}, expected 64 hexadecimal digits")]
    NotADigest {
        /// What was found.
        found: String,
    },
    /// The weights are no readable safetensors file.
    #[error("checkpoint: the weights are not a readable safetensors file: {0}")]
    Weights(#[from] safetensors::SafeTensorError),
    /// A parameter is not f32.
    #[error("checkpoint: parameter {name} has type {found}, expected F32 or F16")]
    DType {
        /// The parameter.
        name: String,
        /// Its type.
        found: String,
    },
    /// The weights do not fit the settings.
    #[error("checkpoint: {0}")]
    Parameters(#[from] ParameterError),
    /// A tensor operation failed.
    #[error("checkpoint: {0}")]
    Tensor(#[from] candle_core::Error),
}

/// `checkpoint.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointSettings {
    /// [`FORMAT`].
    pub format: u32,
    /// `debug`, `small`, `paper` or `custom`.
    pub preset: String,
    /// Seed of the first weights.
    pub seed: u64,
    /// World-model updates behind the weights.
    pub updates: u64,
    /// What it was trained on, in words.
    pub data: String,
    /// Processor time of the run that it took, of all threads, in seconds; 0 where it is not known.
    #[serde(default)]
    pub cpu_seconds: f64,
    /// sha256 of the weights' file, lower-case hexadecimal; empty only before it is written.
    pub weights_sha256: String,
    /// The sizes.
    pub model: ModelSettings,
}

/// Weights with their settings.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    /// What is known about the weights.
    pub settings: CheckpointSettings,
    /// The weights.
    pub parameters: Parameters,
}

impl Checkpoint {
    /// The checksum that the weights' file will have.
    ///
    /// # Errors
    /// Those of reading the parameters.
    pub fn weights_sha256(&self) -> Result<String, CheckpointError> {
        Ok(sha256_hex(&weights_to_bytes(&self.parameters)?))
    }

    /// The same with every weight rounded to the nearest that 16 bits hold: half the size for who ships it, and what is exported of it
    /// compresses to half.
    pub fn rounded(&self) -> Result<Self, CheckpointError> {
        let round = |(name, var): (&str, &candle_core::Var)| {
            Ok((name.to_owned(), var.to_dtype(DType::F16)?.to_dtype(DType::F32)?))
        };
        let tensors = self.parameters.iter().map(round).collect::<Result<_, CheckpointError>>()?;
        let specs = agent::specs(&self.settings.model)?;
        let parameters = Parameters::from_tensors(&specs, tensors, &Device::Cpu)?;
        Ok(Self { settings: self.settings.clone(), parameters })
    }

    /// Writes the checkpoint into `folder`, which is made if it is not there.
    ///
    /// # Errors
    /// See [`CheckpointError`]; a checkpoint that was there before stays readable unless both new files were written.
    pub fn write(&self, folder: &Path) -> Result<(), CheckpointError> {
        fs::create_dir_all(folder)
            .map_err(|source| CheckpointError::Folder { path: folder.to_path_buf(), source })?;
        let weights = weights_to_bytes(&self.parameters)?;
        let settings = CheckpointSettings { weights_sha256: sha256_hex(&weights), ..self.settings.clone() };
        let weights_file = weights_file(&settings.weights_sha256);
        let text = toml::to_string(&settings)?;
        write_atomic(&folder.join(&weights_file), &weights)?;
        write_atomic(&folder.join(SETTINGS_FILE), text.as_bytes())?;
        remove_other_weights(folder, &weights_file)
            .map_err(|source| CheckpointError::Folder { path: folder.to_path_buf(), source })
    }

    /// The folder of the checkpoint that a path means: itself, one of its files' folder, or the newest one of a run's folder.
    ///
    /// # Errors
    /// [`CheckpointError::NoCheckpoint`] says what is there instead.
    pub fn locate(path: &Path) -> Result<PathBuf, CheckpointError> {
        let has_one = |folder: &Path| folder.join(SETTINGS_FILE).is_file();
        let within = ["", "checkpoints/last", "last"].into_iter().map(|place| match place {
            "" => path.to_path_buf(),
            place => path.join(place),
        });
        if let Some(found) = within.into_iter().find(|folder| has_one(folder)) {
            return Ok(found);
        }
        let refuse = |reason: &str| {
            Err(CheckpointError::NoCheckpoint { path: path.to_path_buf(), reason: reason.to_owned() })
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        match path.parent() {
            Some(folder) if path.is_file() && has_one(folder) && name != SETTINGS_FILE => {
                // One of several files of weights would be another checkpoint than its folder's.
                return refuse("a file of a checkpoint; name its folder");
            }
            Some(folder) if path.is_file() && name == SETTINGS_FILE => return Ok(folder.to_path_buf()),
            _ => {}
        }
        if path.is_file() {
            return match path.extension().is_some_and(|ending| ending == "pt" || ending == "pth") {
                true => refuse(
                    "a file of PyTorch; `rcwm-trainer import --from FILE --format FORMAT --out DIR` makes a checkpoint of it",
                ),
                false => refuse("a file; expected a folder with checkpoint.toml, or the folder of a run"),
            };
        }
        if !path.exists() {
            return refuse("no such folder; expected one with checkpoint.toml, or the folder of a run");
        }
        if path.join("manifest.toml").is_file() {
            return refuse(
                "a bundle, which is for rcwm-runtime; expected the checkpoint it was exported from",
            );
        }
        if path.join("settings.toml").is_file() {
            return refuse("a run that has saved no checkpoint yet");
        }
        if path.join("seed-0").is_dir() {
            return refuse("the runs of several seeds; name one of its folders");
        }
        refuse("no checkpoint.toml there, and none in checkpoints/last either")
    }

    /// Reads a checkpoint, of a run the newest ([`Checkpoint::locate`]): exactly the parameters that its settings ask for, of their
    /// shapes, all finite.
    pub fn read(path: &Path, device: &Device) -> Result<Self, CheckpointError> {
        let folder = Self::locate(path)?;
        let stored = || std::fs::read(folder.join(SETTINGS_FILE)).ok();
        loop {
            let before = stored();
            let read = Self::read_from(&folder, device);
            // A run that saves a newer one meanwhile has removed the weights that were asked for.
            if read.is_ok() || stored() == before {
                return read;
            }
        }
    }

    fn read_from(folder: &Path, device: &Device) -> Result<Self, CheckpointError> {
        let settings: CheckpointSettings = rcwm_models::settings::read(&folder.join(SETTINGS_FILE))?;
        if settings.format != FORMAT {
            return Err(CheckpointError::Format { found: settings.format });
        }
        settings.model.validate()?;
        let is_digest = settings.weights_sha256.bytes().all(|byte| byte.is_ascii_hexdigit());
        if settings.weights_sha256.len() != 64 || !is_digest {
            let found = settings.weights_sha256;
            return Err(CheckpointError::NotADigest { found });
        }
        let file = weights_file(&settings.weights_sha256);
        let bytes = read_capped(&folder.join(&file), WEIGHTS_BYTES_MAX)?;
        let found = sha256_hex(&bytes);
        if found != settings.weights_sha256 {
            return Err(CheckpointError::Checksum { file, found, expected: settings.weights_sha256 });
        }
        let tensors = weights_from_bytes(&bytes)?;
        let parameters = Parameters::from_tensors(&agent::specs(&settings.model)?, tensors, device)?;
        Ok(Self { settings, parameters })
    }
}

/// The name of the file with these weights.
fn weights_file(sha256: &str) -> String {
    format!("weights-{}.safetensors", &sha256[..16])
}

fn remove_other_weights(folder: &Path, keep: &str) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with("weights-") && name.ends_with(".safetensors") && name != keep {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

fn weights_to_bytes(parameters: &Parameters) -> Result<Vec<u8>, CheckpointError> {
    let host = |(name, var): (&str, &candle_core::Var)| {
        let whole = var.flatten_all()?.to_device(&Device::Cpu)?;
        let half = whole.to_dtype(DType::F16)?;
        let values = whole.to_vec1::<f32>()?;
        let fits = half.to_dtype(DType::F32)?.to_vec1::<f32>()? == values;
        let halves = half.to_vec1::<half::f16>()?;
        Ok((name.to_owned(), var.dims().to_vec(), fits, values, halves))
    };
    let arrays = parameters.iter().map(host).collect::<Result<Vec<_>, CheckpointError>>()?;
    let all_fit = arrays.iter().all(|(_, _, fits, ..)| *fits);
    let dtype = if all_fit { Dtype::F16 } else { Dtype::F32 };
    let bytes: Vec<Vec<u8>> = arrays
        .iter()
        .map(|(.., values, halves)| match dtype {
            Dtype::F16 => halves.iter().flat_map(|value| value.to_le_bytes()).collect(),
            _ => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        })
        .collect();
    let views = arrays
        .iter()
        .zip(&bytes)
        .map(|((name, shape, ..), bytes)| Ok((name, TensorView::new(dtype, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, CheckpointError>>()?;
    Ok(safetensors::serialize(views, None)?)
}

fn weights_from_bytes(bytes: &[u8]) -> Result<BTreeMap<String, Tensor>, CheckpointError> {
    let mut tensors = BTreeMap::new();
    for (name, view) in SafeTensors::deserialize(bytes)?.tensors() {
        let values: Vec<f32> = match view.dtype() {
            Dtype::F32 => view.data().as_chunks().0.iter().map(|word| f32::from_le_bytes(*word)).collect(),
            Dtype::F16 => {
                let word = |word: &[u8; 2]| half::f16::from_le_bytes(*word).to_f32();
                view.data().as_chunks().0.iter().map(word).collect()
            }
            other => return Err(CheckpointError::DType { found: format!("{other:?}"), name }),
        };
        tensors.insert(name, Tensor::from_vec(values, view.shape(), &Device::Cpu)?);
    }
    Ok(tensors)
}
