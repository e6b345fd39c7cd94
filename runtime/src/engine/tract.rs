//! tract: optimised typed plan, one thread, reused state and inputs.

use std::collections::BTreeSet;
use std::sync::Arc;

use prost::Message as _;
use rcwm_models::bundle::{DType, PartName, TensorSpec};
use rcwm_models::onnx::{self, ValueInfo};
use tract_onnx::prelude::*;
use tract_onnx::tract_core::ops::gru_seq::GruSeq;
use tract_onnx::tract_core::ops::scan::Scan;

use super::{EngineError, EngineKind, Input, Output, Part, Source, TensorContract};

/// Operators that turn some finite numbers into what is none. What follows them may hide that: tract's Relu, Max, Min, Sigmoid and Tanh
/// make a bound of NaN, and any bound makes a number of infinity.
const MAY_DIVERGE: [&str; 10] = [
    "BatchNormalization",
    "Div",
    "Exp",
    "LayerNormalization",
    "Log",
    "LogSoftmax",
    "Pow",
    "Reciprocal",
    "Softplus",
    "Sqrt",
];

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
        // Parts of a world model are normalised everywhere; of anybody else's graph nothing is known.
        let own = if part == PartName::Policy {
            Some(watched(bytes).map_err(|error| contract.load_error(error.to_string()))?)
        } else {
            None
        };
        let state = plan(own.as_deref().unwrap_or(bytes))
            .map_err(|error| contract.load_error(format!("{error:#}")))?;
        let inputs = contract.inputs.iter().map(zeros).collect::<TractResult<Vec<_>>>();
        let inputs = inputs.map_err(|error| contract.load_error(format!("{error:#}")))?;
        Ok(Self { contract, state, inputs })
    }

    /// Whether all that was watched is finite.
    fn try_run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> TractResult<bool> {
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
        for watched in
            results.iter().skip(outputs.len()).filter(|watched| watched.datum_type() == f32::datum_type())
        {
            // Summing |x| * 0 gives 0 for finite numbers and NaN otherwise, and compiles to vector instructions.
            if watched.try_as_plain_ram()?.as_slice::<f32>()?.iter().map(|x| x * 0.0).sum::<f32>() != 0.0 {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// The graph with what may diverge in it among its outputs, after its own.
fn watched(bytes: &[u8]) -> Result<Vec<u8>, onnx::OnnxError> {
    let mut model = onnx::parse_self_contained(bytes)?;
    if let Some(graph) = &mut model.graph {
        let known: BTreeSet<String> = graph.output.iter().map(|info| info.name.clone()).collect();
        let diverging = graph.node.iter().filter(|node| MAY_DIVERGE.contains(&node.op_type.as_str()));
        let names = diverging.filter_map(|node| node.output.first()).filter(|name| !known.contains(*name));
        let more: Vec<_> =
            names.map(|name| ValueInfo { name: name.clone(), ..ValueInfo::default() }).collect();
        graph.output.extend(more);
    }
    Ok(model.encode_to_vec())
}

impl Part for TractPart {
    fn run(&mut self, inputs: &[Input<'_>], outputs: &mut [Output<'_>]) -> Result<(), EngineError> {
        self.contract.check(inputs, outputs)?;
        match self.try_run(inputs, outputs) {
            Ok(true) => Ok(()),
            Ok(false) => Err(EngineError::NotFinite { part: self.contract.part }),
            Err(error) => Err(self.contract.run_error(format!("{error:#}"))),
        }
    }
}

fn plan(bytes: &[u8]) -> TractResult<State> {
    let mut model = tract_onnx::onnx().model_for_read(&mut &bytes[..])?.into_typed()?;
    // Left alone, a cell would go on from its last run: all that is carried is carried by us.
    for node in model.nodes_mut() {
        if let Some(scan) = node.op_as_mut::<Scan>() {
            scan.reset_every_turn = true;
        } else if let Some(gru) = node.op_as_mut::<GruSeq>() {
            gru.reset_every_turn = true;
        }
    }
    TypedSimpleState::new(&model.into_optimized()?.into_runnable()?)
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
