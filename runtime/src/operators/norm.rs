//! LayerNorm over the last dimension, perhaps with `SiLU`.

use std::sync::Arc;

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::NORM;
use super::build::{Context, Recipe, own};
use super::memory::{Results, slice, stateful_op};
use crate::kernels::norm::Norm;

pub(super) fn build(_: &Context<'_>, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    own(node, f32::datum_type(), |recipe| {
        let op = NormOp(Arc::new(NormRows { norm: norm_of(recipe, 1)?, shape: recipe.shape.into() }));
        Ok((Box::new(op), vec![0]))
    })
}

/// The norm whose parameters are the inputs `first` and the one after it.
pub(super) fn norm_of(recipe: &Recipe<'_>, first: usize) -> TractResult<Norm> {
    let (gain, shift) = (recipe.floats(first)?.0.to_vec(), recipe.floats(first + 1)?.0.to_vec());
    if gain.is_empty() || gain.len() != shift.len() || recipe.shape.last() != Some(&gain.len()) {
        bail!("a norm of {} gains and {} shifts over {:?}", gain.len(), shift.len(), recipe.shape);
    }
    let silu = recipe.node.get_attr::<i64>("silu")? != 0;
    Ok(Norm { gain, shift, eps: recipe.node.get_attr("epsilon")?, silu })
}

#[derive(Debug)]
struct NormRows {
    norm: Norm,
    shape: TVec<usize>,
}

#[derive(Debug, Clone)]
struct NormOp(Arc<NormRows>);

#[derive(Debug, Clone)]
struct NormState(Results);

impl NormState {
    fn new(op: &NormOp) -> Self {
        Self(Results::new(f32::datum_type(), &op.0.shape))
    }

    fn run(&mut self, op: &NormOp, inputs: &[TValue]) -> TractResult<TVec<TValue>> {
        let x = slice::<f32>(&inputs[0])?;
        self.0.write(|out| {
            out.copy_from_slice(x);
            op.0.norm.run(Arch::new(), out);
        })
    }
}

stateful_op!(NormOp, NormState, NORM);

impl TypedOp for NormOp {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(f32::fact(&self.0.shape)))
    }

    as_op!();
}
