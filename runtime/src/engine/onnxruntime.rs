//! ONNX Runtime through `ort`, loaded while running.
//!
//! The library is loaded by us, by its path, before anything else of `ort` is touched: `ort` makes its errors through the
//! library, so that a library that is missing could never be reported by `ort` itself.

use std::sync::Mutex;

use ort::environment::Environment;
use ort::memory::Allocator;
use ort::session::{HasSelectedOutputs, OutputSelector, RunOptions, Session, SessionInputValue};
use ort::value::{DynTensor, TensorElementType};
use rcwm_models::bundle::{DType, TensorSpec};

use super::{EngineError, EngineKind, Input, Output, Part, Source, TensorContract};

/// One environment a process is all there may be; it stays until the process ends.
static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// The process's environment; loads the library at first.
pub(super) fn environment() -> Result<Environment, EngineError> {
    let mut kept = ENVIRONMENT.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    if let Some(environment) = &*kept {
        return Ok(environment.clone());
    }
    let path = std::env::var("ORT_DYLIB_PATH").ok().filter(|path| !path.is_empty());
    let path = path.ok_or(EngineError::OrtNotNamed)?;
    let refuse = |reason: String| EngineError::OrtLibrary {
        path: path.clone(),
        reason: rcwm_models::errors::on_one_line(&reason),
    };
    if !std::path::Path::new(&path).is_file() {
        return Err(refuse("there is no such file".into()));
    }
    let builder = ort::init_from(&path).map_err(|error| refuse(error.to_string()))?;
    let environment = builder
        .with_name("rcwm-runtime")
        .with_telemetry(false)
        .build()
        .map_err(|error| refuse(error.to_string()))?;
    environment.set_log_level(ort::logging::LogLevel::Error);
    *kept = Some(environment.clone());
    Ok(environment)
}

/// A part in ONNX Runtime, with inputs and outputs in memory that is kept between runs.
pub(super) struct OrtPart {
    contract: TensorContract,
    session: Session,
    inputs: Vec<SessionInputValue<'static>>,
    options: RunOptions<HasSelectedOutputs>,
}

impl OrtPart {
    pub(super) fn load(source: Source<'_>, threads: usize) -> Result<Self, EngineError> {
        let environment = environment()?;
        let Source { part, bytes, inputs, outputs } = source;
        let contract = TensorContract { engine: EngineKind::Ort, part, inputs, outputs };
        let session =
            open_session(&environment, bytes, threads).map_err(|error| contract.load_error(error))?;
        let (inputs, options) = kept_tensors(&contract).map_err(|error| contract.load_error(error))?;
        Ok(Self { contract, session, inputs, options })
    }

    fn try_run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> ort::Result<()> {
        for (place, input) in self.inputs.iter_mut().zip(inputs) {
            write(place, input)?;
        }
        let results = self.session.run_with_options(self.inputs.as_slice(), &self.options)?;
        for (index, place) in outputs.iter_mut().enumerate() {
            match place {
                Output::I64(place) => place.copy_from_slice(results[index].try_extract_tensor::<i64>()?.1),
                Output::F32(place) => place.copy_from_slice(results[index].try_extract_tensor::<f32>()?.1),
            }
        }
        Ok(())
    }
}

impl Part for OrtPart {
    fn run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> Result<(), EngineError> {
        self.contract.check(inputs, outputs)?;
        self.try_run(inputs, outputs).map_err(|error| self.contract.run_error(error))
    }
}

fn open_session(environment: &Environment, bytes: &[u8], threads: usize) -> ort::Result<Session> {
    Session::builder(environment)?
        .with_intra_threads(threads)?
        .with_inter_threads(1)?
        .with_log_level(ort::logging::LogLevel::Error)?
        // Its threads spin while a part runs, but do not take a core from others afterwards.
        .with_config_entry("session.force_spinning_stop", "1")?
        .commit_from_memory(bytes)
}

type Kept = (Vec<SessionInputValue<'static>>, RunOptions<HasSelectedOutputs>);

fn kept_tensors(contract: &TensorContract) -> ort::Result<Kept> {
    let allocator = Allocator::default();
    let make =
        |spec: &TensorSpec| DynTensor::new(&allocator, element_type(spec.dtype), spec.shape.as_slice());
    let inputs =
        contract.inputs.iter().map(|spec| Ok(make(spec)?.into())).collect::<ort::Result<Vec<_>>>()?;
    let mut selector = OutputSelector::default();
    for spec in &contract.outputs {
        selector = selector.preallocate(&spec.name, make(spec)?);
    }
    Ok((inputs, RunOptions::new()?.with_outputs(selector)))
}

fn element_type(dtype: DType) -> TensorElementType {
    match dtype {
        DType::U8 => TensorElementType::Uint8,
        DType::I64 => TensorElementType::Int64,
        DType::F32 => TensorElementType::Float32,
    }
}

fn write(place: &mut SessionInputValue<'_>, input: &Input<'_>) -> ort::Result<()> {
    let SessionInputValue::Owned(value) = place else {
        return Err(ort::Error::new("an input is not owned"));
    };
    match input {
        Input::U8(x) => value.try_extract_tensor_mut::<u8>()?.1.copy_from_slice(x),
        Input::I64(x) => value.try_extract_tensor_mut::<i64>()?.1.copy_from_slice(x),
        Input::F32(x) => value.try_extract_tensor_mut::<f32>()?.1.copy_from_slice(x),
    }
    Ok(())
}
