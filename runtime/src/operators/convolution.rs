//! Convolution of kernel 4 and stride 2, norm and `SiLU`, channels last; reads floats or bytes.

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::CONV;
use super::build::{Context, custom_op};
use super::compute::Compute;
use super::custom_op::CustomOp;
use super::memory::slice;
use super::norm::norm_of;
use rcwm_kernels::tick::conv::Conv;
use rcwm_kernels::tick::norm::Norm;

/// Work below this is not worth sharing: the pixels would have to go from one core to the other and back.
const SHARED_FLOPS_MIN: usize = 2_000_000;
/// Rows of pixels that are handed over at a time.
const ROWS: usize = 4;

pub(super) fn build(_: &Context<'_>, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    custom_op(node, f32::datum_type(), |context| {
        let (weight, shape) = context.floats(1)?;
        let [channels_out, channels_in, 4, 4] = *shape else { bail!("a weight of shape {shape:?}") };
        let side = 2 * context.shape[1];
        if context.input_len(0)? != side * side * channels_in || !Conv::fits(channels_in, channels_out, side)
        {
            bail!("a convolution of {channels_in} to {channels_out} channels of {side} x {side} pixels");
        }
        let from_bytes = match context.node.get_attr_opt::<f32>("divisor")? {
            Some(divisor) => Some((divisor, context.node.get_attr::<f32>("shift")?)),
            None => None,
        };
        let conv = Conv::new(weight, channels_in, channels_out, side);
        let block = Block { conv, norm: norm_of(context, 2)?, from_bytes, shape: context.shape.into() };
        Ok((CustomOp::boxed(block), vec![0]))
    })
}

#[derive(Debug)]
pub(super) struct Block {
    conv: Conv,
    norm: Norm,
    /// `x / .0 + .1` of bytes, where bytes come in.
    from_bytes: Option<(f32, f32)>,
    shape: TVec<usize>,
}

impl Compute for Block {
    type Number = f32;
    /// The image with its border.
    type Scratch = Vec<f32>;
    const NAME: &'static str = CONV;

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn scratch(&self) -> Vec<f32> {
        vec![0.0; self.conv.len_padded()]
    }

    fn piece_len(&self) -> Option<usize> {
        let conv = &self.conv;
        let flops = 2 * 16 * conv.len_in() / 4 * conv.channels_out();
        (flops >= SHARED_FLOPS_MIN).then(|| ROWS * conv.side_out() * conv.channels_out())
    }

    fn prepare(&self, inputs: &[TValue], padded: &mut Vec<f32>) -> TractResult<()> {
        match self.from_bytes {
            Some(change) => self.conv.pad_bytes(Arch::new(), slice(&inputs[0])?, change, padded),
            None => self.conv.pad(slice(&inputs[0])?, padded),
        }
        Ok(())
    }

    fn fill(&self, _: &[TValue], padded: &Vec<f32>, first: usize, out: &mut [f32]) -> TractResult<()> {
        let (arch, Self { conv, norm, .. }) = (Arch::new(), self);
        let row = conv.side_out() * conv.channels_out();
        conv.run(arch, padded, first / row..(first + out.len()) / row, out);
        norm.run(arch, out);
        Ok(())
    }
}
