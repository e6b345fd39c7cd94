use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use rcwm_models::files::{FileError, read_capped};
use rcwm_models::settings::{ModelKind, ModelSettings, Preset, SettingsError};
use rcwm_models::tensors::{Tensors, TensorsError, Values};
use safetensors::SafeTensors;

/// Largest reference file accepted, in bytes.
const REFERENCE_BYTES_MAX: u64 = 4 << 30;

/// Why a reference file was refused.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// The file could not be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// A tensor is missing or of another type, or the file is no safetensors file.
    #[error("reference file: {0}")]
    Tensors(#[from] TensorsError),
    /// A size in its metadata is missing, no number or too small.
    #[error("reference file: metadata {key}: found {found}, expected {expected}")]
    Metadata {
        key: &'static str,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The sizes do not fit together.
    #[error("reference file: {0}")]
    Settings(#[from] SettingsError),
}

/// Weights, inputs and expected values of one update, with the sizes they belong to.
#[derive(Debug, Clone)]
pub struct Reference {
    /// The sizes of the model.
    pub settings: ModelSettings,
    /// B.
    pub batch: usize,
    /// T.
    pub length: usize,
    /// L: states of an imagination, the start included.
    pub horizon: usize,
    /// Factor of the reward's loss.
    pub reward_scale: f64,
    /// All tensors by name.
    pub tensors: Tensors,
}

impl Reference {
    /// Reads a reference file.
    pub fn read(path: &Path) -> Result<Self, ReferenceError> {
        let bytes = read_capped(path, REFERENCE_BYTES_MAX)?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(TensorsError::Format)?;
        let metadata = header.metadata().clone().unwrap_or_default();
        Self::new(&metadata, Tensors::from_bytes(&bytes)?)
    }

    fn new(metadata: &HashMap<String, String>, tensors: Tensors) -> Result<Self, ReferenceError> {
        let size = |key: &'static str| {
            let text = metadata.get(key).map_or("nothing", String::as_str);
            text.parse::<usize>().map_err(|_| ReferenceError::Metadata {
                key,
                found: text.to_owned(),
                expected: "a size".into(),
            })
        };
        // Widths that the metadata does not name are read off the weights.
        let width = |name: &str, axis: usize| -> Result<usize, ReferenceError> {
            let shape = tensors.get(name)?.shape();
            shape.get(axis).copied().ok_or_else(|| {
                let (found, expected) = (format!("{shape:?}"), format!("at least {} dimensions", axis + 1));
                TensorsError::Unexpected { name: name.to_owned(), found, expected }.into()
            })
        };
        let settings = ModelSettings {
            kind: ModelKind::Rcwm,
            cnn_depth: size("depth")?,
            categoricals: size("stoch")?,
            classes: size("disc")?,
            deter: size("deter")?,
            hidden: width("weights/robot.input.linear.weight", 0)?,
            units: size("units")?,
            bins: width("weights/heads.reward.out.weight", 0)?,
            action: width("input/action", 2)?,
            unimix: 0.01,
            ..ModelSettings::preset(Preset::Paper, ModelKind::Rcwm)
        };
        settings.validate()?;
        let (batch, length, horizon) = (size("batch")?, size("length")?, size("horizon")?);
        let (action, side) = (settings.action, settings.image_side);
        for (name, shape) in [
            ("input/image", vec![batch, length, side, side, settings.image_channels()]),
            ("input/action", vec![batch, length, action]),
            ("input/is_first", vec![batch, length]),
        ] {
            let found = tensors.get(name)?.shape();
            if found != shape {
                let (found, expected) = (format!("{found:?}"), format!("{shape:?}, as the metadata says"));
                return Err(TensorsError::Unexpected { name: name.to_owned(), found, expected }.into());
            }
        }
        for (key, found, least) in [("length", length, 3), ("horizon", horizon, 2)] {
            if found < least {
                let (found, expected) = (found.to_string(), format!("at least {least}"));
                return Err(ReferenceError::Metadata { key, found, expected });
            }
        }
        let text = metadata.get("reward_scale").map_or("nothing", String::as_str);
        let reward_scale = text.parse().map_err(|_| ReferenceError::Metadata {
            key: "reward_scale",
            found: text.to_owned(),
            expected: "a number".into(),
        })?;
        Ok(Self { settings, batch, length, horizon, reward_scale, tensors })
    }

    /// A tensor of the file.
    ///
    /// # Errors
    /// [`TensorsError::Missing`] or candle's.
    pub fn tensor(&self, name: &str, device: &Device) -> Result<Tensor, super::ParityError> {
        let values = self.tensors.get(name).map_err(ReferenceError::from)?;
        Ok(to_tensor(values, device)?)
    }

    /// What errors of a tensor are measured against: its own largest magnitude. A softmax does not see what is added to all of its
    /// inputs, so the gradient of the keys' bias is 0 and the file holds rounding: it is measured against the keys' weight.
    ///
    /// # Errors
    /// [`TensorsError::Missing`] or candle's.
    pub fn unit(&self, name: &str) -> Result<f32, super::ParityError> {
        let name = match name {
            "grad/interaction.key.bias" => "grad/interaction.key.weight",
            _ => name,
        };
        let largest = self.tensor(name, &Device::Cpu)?.flatten_all()?.to_dtype(DType::F32)?.abs()?.max(0)?;
        Ok(largest.to_scalar::<f32>()?.max(f32::MIN_POSITIVE))
    }

    /// The weights, by the parameters' names.
    pub fn weights(&self, device: &Device) -> Result<BTreeMap<String, Tensor>, candle_core::Error> {
        let named = self.tensors.0.iter().filter_map(|(name, values)| {
            name.strip_prefix("weights/").map(|name| Ok((name.to_owned(), to_tensor(values, device)?)))
        });
        named.collect()
    }
}

/// A host array as a tensor on `device`.
pub fn to_tensor(values: &Values, device: &Device) -> Result<Tensor, candle_core::Error> {
    let shape = values.shape();
    match values {
        Values::F32(array) => Tensor::from_iter(array.iter().copied(), device)?.reshape(shape),
        Values::I64(array) => Tensor::from_iter(array.iter().copied(), device)?.reshape(shape),
        Values::U8(array) => Tensor::from_iter(array.iter().copied(), device)?.reshape(shape),
    }
}
