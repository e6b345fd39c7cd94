//! LayerNorm over the last dimension, perhaps with `SiLU`.

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::NORM;
use super::build::{Context, OpContext, custom_op};
use super::compute::Compute;
use super::custom_op::CustomOp;
use super::memory::slice;
use rcwm_kernels::tick::norm::Norm;

pub(super) fn build(_: &Context<'_>, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    custom_op(node, f32::datum_type(), |context| {
        Ok((CustomOp::boxed(NormRows { norm: norm_of(context, 1)?, shape: context.shape.into() }), vec![0]))
    })
}

/// The norm whose parameters are the inputs `first` and the one after it.
pub(super) fn norm_of(context: &OpContext<'_>, first: usize) -> TractResult<Norm> {
    let (gain, shift) = (context.floats(first)?.0.to_vec(), context.floats(first + 1)?.0.to_vec());
    if gain.is_empty() || gain.len() != shift.len() || context.shape.last() != Some(&gain.len()) {
        bail!("a norm of {} gains and {} shifts over {:?}", gain.len(), shift.len(), context.shape);
    }
    let silu = context.node.get_attr::<i64>("silu")? != 0;
    Ok(Norm { gain, shift, eps: context.node.get_attr("epsilon")?, silu })
}

#[derive(Debug)]
pub(super) struct NormRows {
    norm: Norm,
    shape: TVec<usize>,
}

impl Compute for NormRows {
    type Number = f32;
    type Scratch = ();
    const NAME: &'static str = NORM;

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn scratch(&self) {}

    fn fill(&self, inputs: &[TValue], (): &(), _: usize, out: &mut [f32]) -> TractResult<()> {
        out.copy_from_slice(slice(&inputs[0])?);
        self.norm.run(Arch::new(), out);
        Ok(())
    }
}
