//! Logits to log-probabilities, and these with noise to classes.

use std::sync::Arc;

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::build::{Context, own};
use super::memory::{Results, slice, stateful_op};
use super::{DRAW, LOG_PROBS};
use crate::kernels::latents;

pub(super) fn build_log_probs(
    _: &Context<'_>,
    node: &NodeProto,
) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    own(node, f32::datum_type(), |recipe| {
        let (factor, offset) = (recipe.node.get_attr("factor")?, recipe.node.get_attr("offset")?);
        let shape: TVec<usize> = recipe.shape.into();
        let classes = shape.last().copied().filter(|classes| *classes > 0);
        let classes = classes.ok_or_else(|| format_err!("log-probabilities of shape {shape:?}"))?;
        if recipe.input_len(0)? != shape.iter().product::<usize>() {
            bail!("log-probabilities of shape {shape:?} of other logits");
        }
        Ok((Box::new(LogProbsOp(Arc::new(LogProbs { factor, offset, classes, shape }))), vec![0]))
    })
}

pub(super) fn build_draw(
    _: &Context<'_>,
    node: &NodeProto,
) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    own(node, i64::datum_type(), |recipe| {
        let classes: usize = recipe.node.get_attr("classes")?;
        let shape: TVec<usize> = recipe.shape.into();
        let len = shape.iter().product::<usize>() * classes;
        if recipe.input_len(0)? != len || recipe.input_len(1)? != len {
            bail!("classes of shape {shape:?}, {classes} each, of other log-probabilities or noise");
        }
        Ok((Box::new(DrawOp(Arc::new(Draw { classes, shape }))), vec![0, 1]))
    })
}

#[derive(Debug)]
struct LogProbs {
    factor: f32,
    offset: f32,
    classes: usize,
    shape: TVec<usize>,
}

#[derive(Debug, Clone)]
struct LogProbsOp(Arc<LogProbs>);

#[derive(Debug, Clone)]
struct LogProbsState(Results);

impl LogProbsState {
    fn new(op: &LogProbsOp) -> Self {
        Self(Results::new(f32::datum_type(), &op.0.shape))
    }

    fn run(&mut self, op: &LogProbsOp, inputs: &[TValue]) -> TractResult<TVec<TValue>> {
        let logits = slice::<f32>(&inputs[0])?;
        let LogProbs { factor, offset, classes, .. } = *op.0;
        self.0.write(|out| {
            out.copy_from_slice(logits);
            latents::log_probs(Arch::new(), out, classes, factor, offset);
        })
    }
}

stateful_op!(LogProbsOp, LogProbsState, LOG_PROBS);

impl TypedOp for LogProbsOp {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(f32::fact(&self.0.shape)))
    }

    as_op!();
}

#[derive(Debug)]
struct Draw {
    classes: usize,
    shape: TVec<usize>,
}

#[derive(Debug, Clone)]
struct DrawOp(Arc<Draw>);

#[derive(Debug, Clone)]
struct DrawState(Results);

impl DrawState {
    fn new(op: &DrawOp) -> Self {
        Self(Results::new(i64::datum_type(), &op.0.shape))
    }

    fn run(&mut self, op: &DrawOp, inputs: &[TValue]) -> TractResult<TVec<TValue>> {
        let (log_probs, noise) = (slice::<f32>(&inputs[0])?, slice::<f32>(&inputs[1])?);
        self.0.write(|z| latents::draw(log_probs, noise, op.0.classes, z))
    }
}

stateful_op!(DrawOp, DrawState, DRAW);

impl TypedOp for DrawOp {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(i64::fact(&self.0.shape)))
    }

    as_op!();
}
