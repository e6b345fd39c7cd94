//! Logits to log-probabilities, and these with noise to classes.

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::build::{Context, custom_op};
use super::compute::Compute;
use super::custom_op::CustomOp;
use super::memory::slice;
use super::{DRAW, LOG_PROBS};
use rcwm_kernels::tick::latents;

pub(super) fn build_log_probs(
    _: &Context<'_>,
    node: &NodeProto,
) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    custom_op(node, f32::datum_type(), |context| {
        let (factor, offset) = (context.node.get_attr("factor")?, context.node.get_attr("offset")?);
        let shape: TVec<usize> = context.shape.into();
        let classes = shape.last().copied().filter(|classes| *classes > 0);
        let classes = classes.ok_or_else(|| format_err!("log-probabilities of shape {shape:?}"))?;
        if context.input_len(0)? != shape.iter().product::<usize>() {
            bail!("log-probabilities of shape {shape:?} of other logits");
        }
        Ok((CustomOp::boxed(LogProbs { factor, offset, classes, shape }), vec![0]))
    })
}

pub(super) fn build_draw(
    _: &Context<'_>,
    node: &NodeProto,
) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    custom_op(node, i64::datum_type(), |context| {
        let classes: usize = context.node.get_attr("classes")?;
        let shape: TVec<usize> = context.shape.into();
        let len = shape.iter().product::<usize>() * classes;
        if context.input_len(0)? != len || context.input_len(1)? != len {
            bail!("classes of shape {shape:?}, {classes} each, of other log-probabilities or noise");
        }
        Ok((CustomOp::boxed(Draw { classes, shape }), vec![0, 1]))
    })
}

#[derive(Debug)]
struct LogProbs {
    factor: f32,
    offset: f32,
    classes: usize,
    shape: TVec<usize>,
}

impl Compute for LogProbs {
    type Number = f32;
    type Scratch = ();
    const NAME: &'static str = LOG_PROBS;

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn scratch(&self) {}

    fn fill(&self, inputs: &[TValue], (): &(), _: usize, out: &mut [f32]) -> TractResult<()> {
        out.copy_from_slice(slice(&inputs[0])?);
        latents::log_probs(Arch::new(), out, self.classes, self.factor, self.offset);
        Ok(())
    }
}

#[derive(Debug)]
struct Draw {
    classes: usize,
    shape: TVec<usize>,
}

impl Compute for Draw {
    type Number = i64;
    type Scratch = ();
    const NAME: &'static str = DRAW;

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn scratch(&self) {}

    fn fill(&self, inputs: &[TValue], (): &(), _: usize, z: &mut [i64]) -> TractResult<()> {
        latents::draw(slice(&inputs[0])?, slice(&inputs[1])?, self.classes, z);
        Ok(())
    }
}
