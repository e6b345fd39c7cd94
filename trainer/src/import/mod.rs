//! Checkpoints of other implementations: PyTorch's `latest.pt`, read without executing anything, as a checkpoint of ours.
//!
//! Every tensor of floating-point numbers is accounted for: it becomes a parameter, is a copy of one, or is named in the list of what the implementation keeps beside
//! its model. Anything else is refused by name, and so is a parameter that no tensor gives.

mod dreamerv3_torch;
mod names;
mod pickle_check;
mod pytorch;
mod rcwm_authors;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use rcwm_models::settings::{ModelSettings, SettingsError};

use crate::model::agent;
use crate::model::parameters::{ParameterError, Parameters};
use names::{Meaning, Piece};
use pytorch::File;

/// Whose checkpoint a file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// The RCWM of the paper's authors
    RcwmAuthors,
    /// NM512's dreamerv3-torch, with images as its only input
    Dreamerv3Torch,
}

/// What was read.
#[derive(Debug)]
pub struct Imported {
    pub parameters: Parameters,
    pub settings: ModelSettings,
    /// Tensors that became parameters.
    pub taken: usize,
    /// Tensors that are copies of these under another name.
    pub copies: usize,
    /// Tensors of floating-point numbers that are not part of the model.
    pub left: Vec<String>,
}

/// Why a file could not be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    #[error("{0}")]
    File(#[from] rcwm_models::files::FileError),
    /// It is no file of PyTorch's, or damaged.
    #[error(
        "{path}: not a readable PyTorch checkpoint ({reason}); expected the latest.pt of a run, written by torch.save"
    )]
    Unreadable { path: PathBuf, reason: String },
    /// A tensor that the format does not have.
    #[error(
        "{path}: tensor {name} is not known in {format}; is it another implementation's, or one with other inputs?"
    )]
    UnknownTensor { path: PathBuf, name: String, format: &'static str },
    /// A parameter of the model that the file does not give.
    #[error(
        "{path}: no tensor gives {parameter}; the file is damaged, or of another implementation than {format}"
    )]
    Missing { path: PathBuf, parameter: String, format: &'static str },
    /// Two tensors for one parameter.
    #[error("{path}: {name} and {other} are the same parameter; expected one of them")]
    Twice { path: PathBuf, name: String, other: String },
    /// A tensor of another shape, type or layout than the sizes ask for.
    #[error("{path}: tensor {name} is {found}, expected {expected}")]
    Shape { path: PathBuf, name: String, found: String, expected: String },
    #[error("{path}: {source}")]
    Sizes { path: PathBuf, source: SettingsError },
    #[error("{path}: {source}")]
    Parameters { path: PathBuf, source: ParameterError },
    #[error("{path}: {source}")]
    Tensor { path: PathBuf, source: candle_core::Error },
}

impl Format {
    pub fn name(self) -> &'static str {
        match self {
            Self::RcwmAuthors => "rcwm-authors",
            Self::Dreamerv3Torch => "dreamerv3-torch",
        }
    }

    fn meaning(self, name: &str) -> Meaning {
        match self {
            Self::RcwmAuthors => rcwm_authors::meaning(name),
            Self::Dreamerv3Torch => dreamerv3_torch::meaning(name),
        }
    }

    /// The sizes that the shapes of some tensors tell; `classes` where they do not tell how many classes a categorical has.
    fn sizes(self, file: &File, classes: usize) -> Result<ModelSettings, ImportError> {
        match self {
            Self::RcwmAuthors => rcwm_authors::sizes(file),
            Self::Dreamerv3Torch => dreamerv3_torch::sizes(file, classes),
        }
    }
}

/// Reads a checkpoint. `classes` are those of a categorical, which dreamerv3-torch's shapes do not tell.
///
/// # Errors
/// [`ImportError`], which names the file and the tensor.
pub fn import(path: &Path, format: Format, classes: usize) -> Result<Imported, ImportError> {
    let file = File::open(path)?;
    let settings = format.sizes(&file, classes)?;
    settings.validate().map_err(|source| ImportError::Sizes { path: path.to_path_buf(), source })?;
    let at = || path.to_path_buf();
    let parameters = |source| ImportError::Parameters { path: at(), source };
    let specs = agent::specs(&settings).map_err(parameters)?;
    let shapes: BTreeMap<&str, &[usize]> =
        specs.iter().map(|spec| (&*spec.name, spec.shape.as_slice())).collect();
    let mut pieces: BTreeMap<String, BTreeMap<Piece, String>> = BTreeMap::new();
    let (mut copies, mut left) = (0, Vec::new());
    for name in file.names() {
        match format.meaning(name) {
            Meaning::Parameter(to, piece) => {
                if let Some(other) = pieces.entry(to).or_default().insert(piece, name.clone()) {
                    let (name, path) = (name.clone(), at());
                    return Err(ImportError::Twice { path, name, other });
                }
            }
            Meaning::CopyOf(original) if file.are_one(name, &original) => copies += 1,
            Meaning::CopyOf(_) => left.push(name.clone()),
            Meaning::NotOfTheModel => left.push(name.clone()),
            Meaning::Unknown => {
                return Err(ImportError::UnknownTensor {
                    path: at(),
                    name: name.clone(),
                    format: format.name(),
                });
            }
        }
    }
    let mut tensors = BTreeMap::new();
    let mut taken = 0;
    for (parameter, pieces) in pieces {
        let Some(shape) = shapes.get(&*parameter) else {
            let name = pieces.into_values().next().unwrap_or_default();
            return Err(ImportError::UnknownTensor { path: at(), name, format: format.name() });
        };
        taken += pieces.len();
        tensors.insert(parameter.clone(), put_together(&file, &parameter, shape, &pieces, format)?);
    }
    let given: BTreeSet<&str> = tensors.keys().map(String::as_str).collect();
    if let Some(parameter) = shapes.keys().find(|name| !given.contains(*name)) {
        let parameter = (*parameter).to_owned();
        return Err(ImportError::Missing { path: at(), parameter, format: format.name() });
    }
    let parameters = Parameters::from_tensors(&specs, tensors, &Device::Cpu).map_err(parameters)?;
    Ok(Imported { parameters, settings, taken, copies, left })
}

/// One parameter from its tensors.
fn put_together(
    file: &File,
    parameter: &str,
    shape: &[usize],
    pieces: &BTreeMap<Piece, String>,
    format: Format,
) -> Result<Tensor, ImportError> {
    let tensor_error = |source| ImportError::Tensor { path: file.path().to_path_buf(), source };
    let read = |piece: Piece, shape: &[usize]| match pieces.get(&piece) {
        Some(name) => file.get(name, shape),
        None => Err(ImportError::Missing {
            path: file.path().to_path_buf(),
            parameter: parameter.to_owned(),
            format: format.name(),
        }),
    };
    if pieces.contains_key(&Piece::Mean) || pieces.contains_key(&Piece::Spread) {
        let half = [&[shape[0] / 2], &shape[1..]].concat();
        let both = [read(Piece::Mean, &half)?, read(Piece::Spread, &half)?];
        return Tensor::cat(&both, 0).map_err(tensor_error);
    }
    if pieces.contains_key(&Piece::Picture) {
        // Our baseline draws a mask beside the colours: theirs has none, and an output that is always 0 stands in its place.
        let axis = usize::from(shape.len() > 1);
        let colours: Vec<usize> =
            shape.iter().enumerate().map(|(at, side)| if at == axis { side - 1 } else { *side }).collect();
        let picture = read(Piece::Picture, &colours)?;
        return picture.pad_with_zeros(axis, 0, 1).map_err(tensor_error);
    }
    read(Piece::Whole, shape)
}
