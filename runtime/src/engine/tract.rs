//! tract: optimised typed plan, one thread, reused state and inputs.

use std::sync::Arc;

use tract_onnx::prelude::*;

use super::{EngineError, EngineKind, Input, Output, Part, Source, TensorContract};
use rcwm_models::bundle::{DType, TensorSpec};

type State = TypedSimpleState;

pub(super) struct TractPart {
    contract: TensorContract,
    state: State,
    /// Kept between runs: after a run nobody else holds them, and they are written in place.
    inputs: Vec<Arc<Tensor>>,
}

impl TractPart {
    pub(super) fn load(source: Source<'_>) -> Result<Self, EngineError> {
        let Source { part, bytes, inputs, outputs } = source;
        let contract = TensorContract { engine: EngineKind::Tract, part, inputs, outputs };
        let state = plan(bytes).map_err(|error| contract.load_error(format!("{error:#}")))?;
        let inputs = contract.inputs.iter().map(zeros).collect::<TractResult<Vec<_>>>();
        let inputs = inputs.map_err(|error| contract.load_error(format!("{error:#}")))?;
        Ok(Self { contract, state, inputs })
    }

    fn try_run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> TractResult<()> {
        for (place, input) in self.inputs.iter_mut().zip(inputs) {
            // A clone happens only if the plan has kept the last input, which ours do not.
            write(Arc::make_mut(place), input)?;
        }
        let values = self.inputs.iter().map(|tensor| tensor.clone().into_tvalue()).collect();
        let results = self.state.run(values)?;
        for (place, result) in outputs.iter_mut().zip(&results) {
            match place {
                Output::I64(place) => copy(place, result)?,
                Output::F32(place) => copy(place, result)?,
            }
        }
        Ok(())
    }
}

impl Part for TractPart {
    fn run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> Result<(), EngineError> {
        self.contract.check(inputs, outputs)?;
        self.try_run(inputs, outputs).map_err(|error| self.contract.run_error(format!("{error:#}")))
    }
}

fn plan(bytes: &[u8]) -> TractResult<State> {
    let model = tract_onnx::onnx().model_for_read(&mut &bytes[..])?.into_optimized()?;
    TypedSimpleState::new(&model.into_runnable()?)
}

fn zeros(spec: &TensorSpec) -> TractResult<Arc<Tensor>> {
    let shape = &spec.shape;
    let tensor = match spec.dtype {
        DType::U8 => Tensor::zero::<u8>(shape),
        DType::I64 => Tensor::zero::<i64>(shape),
        DType::F32 => Tensor::zero::<f32>(shape),
    };
    tensor.map(Arc::new)
}

fn write(tensor: &mut Tensor, input: &Input<'_>) -> TractResult<()> {
    let mut view = tensor.try_as_plain_ram_mut()?;
    match input {
        Input::U8(x) => view.as_slice_mut::<u8>()?.copy_from_slice(x),
        Input::I64(x) => view.as_slice_mut::<i64>()?.copy_from_slice(x),
        Input::F32(x) => view.as_slice_mut::<f32>()?.copy_from_slice(x),
    }
    Ok(())
}

fn copy<T: Datum + Copy>(place: &mut [T], tensor: &Tensor) -> TractResult<()> {
    let view = tensor.try_as_plain_ram()?;
    let values = view.as_slice::<T>()?;
    if values.len() != place.len() {
        anyhow::bail!("an output has {} elements, expected {}", values.len(), place.len());
    }
    place.copy_from_slice(values);
    Ok(())
}
