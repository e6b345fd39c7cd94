//! Segments loaded into tract, and the values that go between them without being copied.

use std::sync::Arc;

use rcwm_models::bundle::PartName;
use rcwm_models::onnx::data_type;
use tract_onnx::prelude::*;
use tract_onnx::tract_core::plan::eval;

use super::super::PolicyError;
use crate::compile::{CompileError, Fact, Segment};
use crate::engine::Input;
use crate::operators::{self, SharedTeam};

/// The values of a tick.
#[derive(Default)]
pub(super) struct Values {
    names: Vec<String>,
    tensors: Vec<Arc<Tensor>>,
}

/// Where a value lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place(usize);

impl Values {
    /// The place of a value.
    pub(super) fn find(&self, name: &str) -> Option<Place> {
        self.names.iter().position(|known| known == name).map(Place)
    }

    /// The same; a new one holds zeros.
    pub(super) fn place(&mut self, name: &str, fact: Option<&Fact>) -> TractResult<Place> {
        if let Some(place) = self.find(name) {
            return Ok(place);
        }
        let tensor = match fact {
            None => Tensor::zero::<f32>(&[0])?,
            Some(fact) => match fact.dtype {
                data_type::UINT8 => Tensor::zero::<u8>(&fact.shape)?,
                data_type::INT64 => Tensor::zero::<i64>(&fact.shape)?,
                _ => Tensor::zero::<f32>(&fact.shape)?,
            },
        };
        self.tensors.push(Arc::new(tensor));
        self.names.push(name.to_owned());
        Ok(Place(self.tensors.len() - 1))
    }

    /// Writes one of the tick's inputs; one that no segment reads has no place, and is left out.
    pub(super) fn fill<T: Datum + Copy>(&mut self, place: Option<Place>, from: &[T]) -> TractResult<()> {
        let Some(Place(place)) = place else { return Ok(()) };
        // A clone happens only if a segment has kept it, which ours do not.
        let tensor = Arc::make_mut(&mut self.tensors[place]);
        let mut view = tensor.try_as_plain_ram_mut()?;
        let to = view.as_slice_mut::<T>()?;
        if to.len() != from.len() {
            anyhow::bail!("{} has {} elements, expected {}", self.names[place], from.len(), to.len());
        }
        to.copy_from_slice(from);
        Ok(())
    }

    /// Reads a value.
    pub(super) fn copy<T: Datum + Copy>(&self, Place(place): Place, to: &mut [T]) -> TractResult<()> {
        let view = self.tensors[place].try_as_plain_ram()?;
        let from = view.as_slice::<T>()?;
        if to.len() != from.len() {
            anyhow::bail!("{} has {} elements, expected {}", self.names[place], from.len(), to.len());
        }
        to.copy_from_slice(from);
        Ok(())
    }

    /// A value as another engine takes it.
    pub(super) fn input(&self, Place(place): Place) -> TractResult<Input<'_>> {
        let tensor = &self.tensors[place];
        let view = tensor.try_as_plain_ram()?;
        Ok(match tensor.datum_type() {
            DatumType::U8 => Input::U8(view.as_slice()?),
            DatumType::I64 => Input::I64(view.as_slice()?),
            _ => Input::F32(view.as_slice()?),
        })
    }

    /// Makes one value stand for another.
    pub(super) fn alias(&mut self, of: Place, place: Place) {
        self.tensors[place.0] = Arc::clone(&self.tensors[of.0]);
    }
}

/// Somebody else was faster.
#[derive(Debug, thiserror::Error)]
#[error("no longer wanted")]
struct Unwanted;

/// A segment in tract.
pub(super) struct Piece {
    pub(super) part: PartName,
    inputs: Vec<Place>,
    outputs: Vec<Place>,
    state: TypedSimpleState,
    /// Made beforehand: an error that is made in a tick asks the allocator, and may look at the whole stack.
    unwanted: Option<TractError>,
}

impl Piece {
    pub(super) fn load(
        segment: &Segment,
        values: &mut Values,
        team: Option<&SharedTeam>,
    ) -> Result<Self, PolicyError> {
        Self::try_load(segment, values, team).map_err(|error| {
            let reason = rcwm_models::errors::on_one_line(&format!("{error:#}"));
            CompileError::Part { part: segment.part, reason }.into()
        })
    }

    fn try_load(segment: &Segment, values: &mut Values, team: Option<&SharedTeam>) -> TractResult<Self> {
        let mut model =
            operators::onnx().model_for_read(&mut &segment.onnx[..])?.into_typed()?.into_decluttered()?;
        operators::bind_threads(&mut model, team);
        let state = TypedSimpleState::new(&model.into_optimized()?.into_runnable()?)?;
        let inputs = segment
            .inputs
            .iter()
            .map(|(name, fact)| values.place(name, Some(fact)))
            .collect::<TractResult<_>>()?;
        let outputs =
            segment.outputs.iter().map(|(name, _)| values.place(name, None)).collect::<TractResult<_>>()?;
        Ok(Self { part: segment.part, inputs, outputs, state, unwanted: Some(Unwanted.into()) })
    }

    /// The same again, with memory of its own; weights are shared.
    pub(super) fn try_clone(&self) -> TractResult<Self> {
        let state = TypedSimpleState::new(self.state.plan())?;
        let (inputs, outputs) = (self.inputs.clone(), self.outputs.clone());
        Ok(Self { part: self.part, inputs, outputs, state, unwanted: Some(Unwanted.into()) })
    }

    pub(super) fn makes(&self, place: Place) -> bool {
        self.outputs.contains(&place)
    }

    /// What goes in.
    pub(super) fn inputs(&self, values: &Values) -> TVec<TValue> {
        self.inputs.iter().map(|place| Arc::clone(&values.tensors[place.0]).into_tvalue()).collect()
    }

    pub(super) fn run_on(&mut self, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        self.state.run(inputs)
    }

    /// The same, given up between two of its operators as soon as it is unwanted; none then.
    pub(super) fn run_unless(
        &mut self,
        unwanted: impl Fn() -> bool,
        inputs: TVec<TValue>,
    ) -> TractResult<Option<TVec<TValue>>> {
        let error = &mut self.unwanted;
        let result = self.state.run_plan_with_eval(inputs, |context, state, node, inputs| {
            match error.take_if(|_| unwanted()) {
                Some(error) => Err(error),
                None => eval(context, state, node, inputs),
            }
        });
        match result {
            Err(error) if error.is::<Unwanted>() => {
                self.unwanted = Some(error);
                self.state.reset_turn().map(|()| None)
            }
            result => result.map(Some),
        }
    }

    /// Puts what came out where others find it.
    pub(super) fn keep(&self, results: TVec<TValue>, values: &mut Values) {
        for (place, result) in self.outputs.iter().zip(results) {
            values.tensors[place.0] = result.into_arc_tensor();
        }
    }

    pub(super) fn run(&mut self, values: &mut Values) -> TractResult<()> {
        let results = self.run_on(self.inputs(values))?;
        self.keep(results, values);
        Ok(())
    }
}
