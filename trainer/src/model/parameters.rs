//! All parameters of a model in one place, by name.
//!
//! A model is built against a [`Scope`], which is asked for tensors by name and shape. Built against a recording scope, it
//! lists what it needs ([`ParameterSpec`]); built against [`Parameters`], it shares their storage, so that updating a
//! parameter is seen by every model built on it. Names and layouts are PyTorch's: linear `[out, in]`, convolution `[out, in, 4,
//! 4]`, transposed convolution `[in, out, 4, 4]`.

use std::cell::RefCell;
use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};

use super::init::{Init, draw};

/// Why parameters could not be made or a model could not be built on them.
#[derive(Debug, thiserror::Error)]
pub enum ParameterError {
    /// The model needs a parameter that is not there.
    #[error("parameter {name} {shape:?} is missing; were the weights made for another kind of model?")]
    Missing {
        /// The parameter.
        name: String,
        shape: Vec<usize>,
    },
    /// A parameter that the model does not have.
    #[error(
        "parameter {name} {shape:?} belongs to no part of this model; were the weights made for another kind?"
    )]
    Unknown {
        /// The parameter.
        name: String,
        shape: Vec<usize>,
    },
    /// A parameter has another shape than the settings say.
    #[error("parameter {name} has shape {found:?}, the model's sizes make it {expected:?}")]
    Shape {
        /// The parameter.
        name: String,
        /// The shape it has.
        found: Vec<usize>,
        /// The shape it must have.
        expected: Vec<usize>,
    },
    /// A parameter holds NaN or an infinity.
    #[error("parameter {name} holds {count} values that are not finite; use an older checkpoint")]
    NotFinite {
        /// The parameter.
        name: String,
        /// How many such values.
        count: usize,
    },
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// A part of a model, or why it could not be built.
pub type Built<T> = Result<T, ParameterError>;

/// What a model needs under one name.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterSpec {
    /// Dotted name, as in checkpoints.
    pub name: String,
    pub shape: Vec<usize>,
    /// How it starts.
    pub init: Init,
}

/// Named trainable arrays.
#[derive(Debug, Clone)]
pub struct Parameters {
    vars: BTreeMap<String, Var>,
    device: Device,
}

impl Parameters {
    /// Fresh parameters. Each is drawn from its own stream of the seed, named by the parameter: the same seed gives the same
    /// weights whatever else the model has. The slow critic starts as a copy of the critic.
    pub fn initialise(specs: &[ParameterSpec], seed: u64, device: &Device) -> Result<Self, ParameterError> {
        let mut vars = BTreeMap::new();
        for spec in specs {
            let stream = spec.name.strip_prefix("slow_").unwrap_or(&spec.name);
            let values = draw(&spec.init, &spec.shape, seed, stream);
            vars.insert(spec.name.clone(), Var::from_vec(values, spec.shape.as_slice(), device)?);
        }
        Ok(Self { vars, device: device.clone() })
    }

    /// Parameters with given values: exactly the names and shapes of `specs`, all finite.
    pub fn from_tensors(
        specs: &[ParameterSpec],
        mut tensors: BTreeMap<String, Tensor>,
        device: &Device,
    ) -> Result<Self, ParameterError> {
        let mut vars = BTreeMap::new();
        for ParameterSpec { name, shape, .. } in specs {
            let tensor = tensors
                .remove(name)
                .ok_or_else(|| ParameterError::Missing { name: name.clone(), shape: shape.clone() })?;
            if tensor.dims() != shape.as_slice() {
                let found = tensor.dims().to_vec();
                return Err(ParameterError::Shape { name: name.clone(), found, expected: shape.clone() });
            }
            let values = tensor.flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>()?;
            let count = values.iter().filter(|value| !value.is_finite()).count();
            if count > 0 {
                return Err(ParameterError::NotFinite { name: name.clone(), count });
            }
            vars.insert(name.clone(), Var::from_vec(values, shape.as_slice(), device)?);
        }
        match tensors.pop_first() {
            None => Ok(Self { vars, device: device.clone() }),
            Some((name, tensor)) => Err(ParameterError::Unknown { name, shape: tensor.dims().to_vec() }),
        }
    }

    /// The parameter of this name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Var> {
        self.vars.get(name)
    }

    /// All parameters, by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.vars.iter().map(|(name, var)| (name.as_str(), var))
    }

    /// Where they live.
    #[must_use]
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Parameters of their own with the same values.
    pub fn copied(&self) -> Result<Self, ParameterError> {
        let copy = |(name, var): (&String, &Var)| {
            Ok((name.clone(), Var::from_tensor(&var.as_detached_tensor().copy()?)?))
        };
        let vars = self.vars.iter().map(copy).collect::<Result<_, candle_core::Error>>()?;
        Ok(Self { vars, device: self.device.clone() })
    }

    /// Moves the parameters whose names `moves` accepts towards those of the same name in `other`: by nothing at a `share` of 0, all
    /// the way at 1.
    ///
    /// # Errors
    /// [`ParameterError::Missing`] where `other` has none of a name, or [`ParameterError::Tensor`].
    pub fn mix(&self, other: &Self, share: f64, moves: impl Fn(&str) -> bool) -> Result<(), ParameterError> {
        for (name, var) in self.vars.iter().filter(|(name, _)| moves(name)) {
            let missing = || ParameterError::Missing { name: name.clone(), shape: var.dims().to_vec() };
            mix(var, other.get(name).ok_or_else(missing)?, share)?;
        }
        Ok(())
    }

    /// A scope that gives the parameters themselves: gradients reach them.
    #[must_use]
    pub fn trainable(&self) -> Scope<'_> {
        self.trainable_where(|_| true)
    }

    /// A scope that gives the same values, always current, without gradients.
    #[must_use]
    pub fn frozen(&self) -> Scope<'_> {
        self.trainable_where(|_| false)
    }

    /// A scope in which gradients reach the parameters whose names `trains` accepts, and no others.
    #[must_use]
    pub fn trainable_where(&self, trains: fn(&str) -> bool) -> Scope<'_> {
        Scope { source: Source::Shared { parameters: self, trains }, prefix: String::new() }
    }
}

/// Moves `var` towards `goal` by this share of the way.
pub fn mix(var: &Var, goal: &Var, share: f64) -> candle_core::Result<()> {
    let mixed = ((goal.as_detached_tensor() * share)? + (var.as_detached_tensor() * (1.0 - share))?)?;
    var.set(&mixed)
}

/// Lists what a model asks for while it is built.
#[derive(Debug, Default)]
pub struct Recorder(RefCell<Vec<ParameterSpec>>);

impl Recorder {
    /// A scope that records names and gives zeros that take no memory.
    #[must_use]
    pub fn scope(&self) -> Scope<'_> {
        Scope { source: Source::Recording(&self.0), prefix: String::new() }
    }

    /// What was asked for, in order.
    #[must_use]
    pub fn into_specs(self) -> Vec<ParameterSpec> {
        self.0.into_inner()
    }
}

#[derive(Debug, Clone, Copy)]
enum Source<'a> {
    Recording(&'a RefCell<Vec<ParameterSpec>>),
    Shared { parameters: &'a Parameters, trains: fn(&str) -> bool },
}

/// A place in the tree of names from which a part of a model takes its parameters.
#[derive(Debug, Clone)]
pub struct Scope<'a> {
    source: Source<'a>,
    prefix: String,
}

impl Scope<'_> {
    /// The scope below `name`.
    #[must_use]
    pub fn at(&self, name: impl std::fmt::Display) -> Self {
        Self { source: self.source, prefix: self.full(&name.to_string()) }
    }

    /// The tensor of this name.
    ///
    /// # Errors
    /// [`ParameterError::Missing`], [`ParameterError::Shape`] or [`ParameterError::Tensor`].
    pub fn get(&self, name: &str, shape: &[usize], init: Init) -> Result<Tensor, ParameterError> {
        let name = self.full(name);
        match self.source {
            Source::Recording(specs) => {
                specs.borrow_mut().push(ParameterSpec { name, shape: shape.to_vec(), init });
                Ok(Tensor::zeros((), DType::F32, &Device::Cpu)?.broadcast_as(shape)?)
            }
            Source::Shared { parameters, trains } => {
                let var = parameters
                    .get(&name)
                    .ok_or_else(|| ParameterError::Missing { name: name.clone(), shape: shape.to_vec() })?;
                if var.dims() != shape {
                    let found = var.dims().to_vec();
                    return Err(ParameterError::Shape { name, found, expected: shape.to_vec() });
                }
                Ok(if trains(&name) { var.as_tensor().clone() } else { var.as_detached_tensor() })
            }
        }
    }

    /// Where the tensors live.
    #[must_use]
    pub fn device(&self) -> Device {
        match self.source {
            Source::Recording(_) => Device::Cpu,
            Source::Shared { parameters, .. } => parameters.device.clone(),
        }
    }

    fn full(&self, name: &str) -> String {
        if self.prefix.is_empty() { name.to_owned() } else { format!("{}.{name}", self.prefix) }
    }
}
