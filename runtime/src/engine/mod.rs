//! What runs an ONNX part. One trait, two engines.
//!
//! A part takes and gives its tensors in the order of its signature, as flat slices in row-major order; the caller owns every
//! buffer, so that a tick allocates nothing on our side.

#[cfg(feature = "ort")]
mod onnxruntime;
mod tract;
pub(crate) mod weights;

use rcwm_models::bundle::{Bundle, DType, PartName, TensorSpec};
use rcwm_models::onnx::data_type;
use serde::{Deserialize, Serialize};

use crate::compile::{Fact, Optimizations};

/// Which engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum EngineKind {
    /// tract, compiled in.
    Tract,
    /// ONNX Runtime, loaded from the library that ORT_DYLIB_PATH names.
    Ort,
}

impl EngineKind {
    /// The name on the command line.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Tract => "tract",
            Self::Ort => "ort",
        }
    }
}

impl std::fmt::Display for EngineKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// What is run of a bundle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// The parts as exported, one after another once the image is there.
    Exported,
    /// Their segments, ahead of the image where they can be, with our operators in place of hot nodes; tract only.
    Compiled(Optimizations),
    /// Two graphs, cut where the image comes in: the first is worked ahead; ONNX Runtime only.
    Split,
}

/// Which engine, and how much of the machine it may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EngineSettings {
    /// Which engine.
    pub kind: EngineKind,
    /// Threads of a tick: of tract 1 or 2, of ONNX Runtime those inside an operator.
    pub threads: usize,
    /// What is run.
    pub form: Form,
}

impl EngineSettings {
    /// tract as it is deployed: the compiled tick, on two threads where the machine has them.
    #[must_use]
    pub fn tract() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self { threads: cores.min(2), ..Self::single_threaded(EngineKind::Tract) }
    }

    /// ONNX Runtime with this many threads inside an operator, on the exported parts.
    #[must_use]
    pub const fn ort(threads: usize) -> Self {
        Self { kind: EngineKind::Ort, threads, form: Form::Exported }
    }

    /// An engine with one thread.
    #[must_use]
    pub const fn single_threaded(kind: EngineKind) -> Self {
        let form = match kind {
            EngineKind::Tract => Form::Compiled(Optimizations::EXACT),
            EngineKind::Ort => Form::Exported,
        };
        Self { kind, threads: 1, form }
    }

    /// An engine as it is deployed, with what was chosen on a command line.
    ///
    /// # Errors
    /// [`EngineError::Choice`] for what the engine does not have.
    pub fn chosen(kind: EngineKind, threads: Option<u16>, half_weights: bool) -> Result<Self, EngineError> {
        let refuse =
            |what: String, instead: &str| Err(EngineError::Choice { what, instead: instead.to_owned() });
        let usual = match (kind, threads) {
            (EngineKind::Tract, Some(threads @ 3..)) => {
                return refuse(
                    format!("--threads {threads} with engine tract"),
                    "its tick runs on 1 or 2 threads",
                );
            }
            (EngineKind::Ort, _) if half_weights => {
                return refuse(
                    "--half-weights with engine ort".into(),
                    "only tract keeps weights in 16 bits",
                );
            }
            (EngineKind::Tract, _) => Self::tract().with_half_weights(half_weights),
            (EngineKind::Ort, _) => Self::ort(1),
        };
        Ok(threads.map_or(usual, |threads| usual.with_threads(threads.into())))
    }

    /// With another number of threads.
    #[must_use]
    pub const fn with_threads(self, threads: usize) -> Self {
        Self { threads, ..self }
    }

    /// With the weights of layers kept in 16 bits, where the form is compiled.
    #[must_use]
    pub const fn with_half_weights(self, half_weights: bool) -> Self {
        match self.form {
            Form::Compiled(optimizations) => {
                self.with_form(Form::Compiled(Optimizations { half_weights, ..optimizations }))
            }
            Form::Exported | Form::Split => self,
        }
    }

    /// Whether the weights of layers are kept in 16 bits.
    #[must_use]
    pub const fn has_half_weights(self) -> bool {
        matches!(self.form, Form::Compiled(Optimizations { half_weights: true, .. }))
    }

    /// With another form.
    #[must_use]
    pub const fn with_form(self, form: Form) -> Self {
        Self { form, ..self }
    }
}

/// Why an engine could not load or run a part.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// Nobody said where ONNX Runtime is.
    #[error(
        "engine ort: ORT_DYLIB_PATH is not set; `pip install onnxruntime==1.31.1` and set it to the file \
         site-packages/onnxruntime/capi/libonnxruntime.so.1.31.1, or use --engine tract"
    )]
    OrtNotNamed,
    /// The library that was named cannot be used.
    #[error(
        "engine ort: ORT_DYLIB_PATH={path}: {reason}; name a libonnxruntime.so of version 1.{} or later, or use \
         --engine tract",
        ORT_MINOR_MIN
    )]
    OrtLibrary {
        /// What ORT_DYLIB_PATH says.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The program was built without it.
    #[error("engine ort: this program was built without the feature `ort`; use --engine tract")]
    OrtNotBuilt,
    /// A choice that the engine does not have.
    #[error("{what}: {instead}")]
    Choice { what: String, instead: String },
    /// Somewhere inside a graph stands what is no number, whatever its outputs say.
    #[error("{part}: a value inside the graph is not finite")]
    NotFinite { part: PartName },
    /// The bundle does not have the part.
    #[error("the bundle has no {part}")]
    NoPart { part: PartName },
    /// A weight that no training gives.
    #[error(
        "{part}: weight {tensor:?} holds {found}, accepted are finite values up to 1e6, with 16-bit weights up to 65504; the bundle \
         is damaged or its training has diverged: export another checkpoint"
    )]
    Weights { part: PartName, tensor: String, found: String },
    /// A part could not be made ready.
    #[error("engine {engine}: loading {part}: {reason}")]
    Load { engine: EngineKind, part: PartName, reason: String },
    /// A part failed while running.
    #[error("engine {engine}: running {part}: {reason}")]
    Run { engine: EngineKind, part: PartName, reason: String },
    /// A tensor that was handed over is not the one the part takes or gives.
    #[error("engine {engine}: {part}: {found}, expected {expected}")]
    Tensor {
        engine: EngineKind,
        part: PartName,
        /// What was handed over.
        found: String,
        /// What the signature says.
        expected: String,
    },
}

/// Minor version of the oldest ONNX Runtime whose interface we use.
pub const ORT_MINOR_MIN: u32 = 31;

/// A tensor that enters a part, row-major.
#[derive(Debug, Clone, Copy)]
pub enum Input<'a> {
    /// Bytes.
    U8(&'a [u8]),
    /// Class indices.
    I64(&'a [i64]),
    /// Floats.
    F32(&'a [f32]),
}

impl Input<'_> {
    fn describe(&self) -> (DType, usize) {
        match self {
            Self::U8(x) => (DType::U8, x.len()),
            Self::I64(x) => (DType::I64, x.len()),
            Self::F32(x) => (DType::F32, x.len()),
        }
    }
}

/// A place for a tensor that leaves a part, row-major.
#[derive(Debug)]
pub enum Output<'a> {
    /// Class indices.
    I64(&'a mut [i64]),
    /// Floats.
    F32(&'a mut [f32]),
}

impl Output<'_> {
    fn describe(&self) -> (DType, usize) {
        match self {
            Self::I64(x) => (DType::I64, x.len()),
            Self::F32(x) => (DType::F32, x.len()),
        }
    }
}

/// A loaded part.
pub trait Part: Send {
    /// Runs the part once. Inputs and outputs are in the order of the signature.
    ///
    /// # Errors
    /// [`EngineError::Tensor`] before anything runs, or [`EngineError::Run`].
    fn run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> Result<(), EngineError>;
}

/// Everything an engine needs to load a part.
struct Source<'a> {
    part: PartName,
    bytes: &'a [u8],
    inputs: Vec<TensorSpec>,
    outputs: Vec<TensorSpec>,
}

/// Loads a part of a bundle.
///
/// # Errors
/// [`EngineError::NoPart`], [`EngineError::Weights`], [`EngineError::Load`], or what is wrong with ONNX Runtime's library.
pub fn load(bundle: &Bundle, part: PartName, settings: EngineSettings) -> Result<Box<dyn Part>, EngineError> {
    let bytes = bundle.part(part).ok_or(EngineError::NoPart { part })?;
    weights::check(part, bytes, weights::WEIGHT_MAX)?;
    let entry = bundle.manifest.part(part).ok_or(EngineError::NoPart { part })?;
    let (inputs, outputs) = (entry.inputs.clone(), entry.outputs.clone());
    load_source(Source { part, bytes, inputs, outputs }, settings)
}

/// Loads a graph that was put together from checked parts; `tensors` are what goes in and what comes out.
pub(crate) fn load_graph(
    part: PartName,
    bytes: &[u8],
    tensors: [&[(String, Fact)]; 2],
    settings: EngineSettings,
) -> Result<Box<dyn Part>, EngineError> {
    let spec = |(name, fact): &(String, Fact)| {
        let dtype = match fact.dtype {
            data_type::UINT8 => DType::U8,
            data_type::INT64 => DType::I64,
            _ => DType::F32,
        };
        TensorSpec::new(name, dtype, &fact.shape)
    };
    let [inputs, outputs] = tensors.map(|tensors| tensors.iter().map(spec).collect());
    load_source(Source { part, bytes, inputs, outputs }, settings)
}

fn load_source(source: Source<'_>, settings: EngineSettings) -> Result<Box<dyn Part>, EngineError> {
    match settings.kind {
        EngineKind::Tract => Ok(Box::new(tract::TractPart::load(source)?)),
        EngineKind::Ort => load_ort(source, settings.threads),
    }
}

#[cfg(feature = "ort")]
fn load_ort(source: Source<'_>, threads: usize) -> Result<Box<dyn Part>, EngineError> {
    Ok(Box::new(onnxruntime::OrtPart::load(source, threads)?))
}

#[cfg(not(feature = "ort"))]
fn load_ort(_: Source<'_>, _: usize) -> Result<Box<dyn Part>, EngineError> {
    Err(EngineError::OrtNotBuilt)
}

/// Whether the engine can be used on this machine, and if not, why.
///
/// # Errors
/// What is wrong with ONNX Runtime's library; tract is always there.
pub fn available(kind: EngineKind) -> Result<(), EngineError> {
    match kind {
        EngineKind::Tract => Ok(()),
        #[cfg(feature = "ort")]
        EngineKind::Ort => onnxruntime::environment().map(drop),
        #[cfg(not(feature = "ort"))]
        EngineKind::Ort => Err(EngineError::OrtNotBuilt),
    }
}

/// Names of a part's tensors and how to say that something does not fit.
struct TensorContract {
    engine: EngineKind,
    part: PartName,
    inputs: Vec<TensorSpec>,
    outputs: Vec<TensorSpec>,
}

impl TensorContract {
    fn check(&self, inputs: &[Input<'_>], outputs: &[Output<'_>]) -> Result<(), EngineError> {
        self.compare("inputs", inputs.iter().map(Input::describe), &self.inputs)?;
        self.compare("outputs", outputs.iter().map(Output::describe), &self.outputs)
    }

    fn compare(
        &self,
        role: &str,
        found: impl ExactSizeIterator<Item = (DType, usize)> + Clone,
        specs: &[TensorSpec],
    ) -> Result<(), EngineError> {
        let expected = specs.iter().map(|spec| (spec.dtype, spec.shape.iter().product::<usize>()));
        if found.clone().eq(expected.clone()) {
            return Ok(());
        }
        let list = |tensors: Vec<(DType, usize)>| format!("{role} of type and length {tensors:?}");
        Err(EngineError::Tensor {
            engine: self.engine,
            part: self.part,
            found: list(found.collect()),
            expected: list(expected.collect()),
        })
    }

    fn load_error(&self, reason: impl std::fmt::Display) -> EngineError {
        EngineError::Load {
            engine: self.engine,
            part: self.part,
            reason: rcwm_models::errors::on_one_line(&reason.to_string()),
        }
    }

    fn run_error(&self, reason: impl std::fmt::Display) -> EngineError {
        EngineError::Run {
            engine: self.engine,
            part: self.part,
            reason: rcwm_models::errors::on_one_line(&reason.to_string()),
        }
    }
}

#[cfg(test)]
mod tests;
