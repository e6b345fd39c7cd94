//! Convolution of kernel 4 and stride 2, norm and `SiLU`, channels last; reads floats or bytes.

use std::sync::Arc;

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::build::{Context, own};
use super::memory::{Pieces, Results, slice, stateful_op};
use super::norm::norm_of;
use super::{CONV, SharedTeam};
use crate::kernels::conv::Conv;
use crate::kernels::norm::Norm;

/// Work below this is not worth sharing: the pixels would have to go from one core to the other and back.
const SHARED_FLOPS_MIN: usize = 2_000_000;
/// Rows of pixels that are handed over at a time.
const ROWS: usize = 4;

pub(super) fn build(_: &Context<'_>, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    own(node, f32::datum_type(), |recipe| {
        let (weight, shape) = recipe.floats(1)?;
        let [channels_out, channels_in, 4, 4] = *shape else { bail!("a weight of shape {shape:?}") };
        let side = 2 * recipe.shape[1];
        if recipe.input_len(0)? != side * side * channels_in || !Conv::fits(channels_in, channels_out, side) {
            bail!("a convolution of {channels_in} to {channels_out} channels of {side} x {side} pixels");
        }
        let from_bytes = match recipe.node.get_attr_opt::<f32>("divisor")? {
            Some(divisor) => Some((divisor, recipe.node.get_attr::<f32>("shift")?)),
            None => None,
        };
        let conv = Conv::new(weight, channels_in, channels_out, side);
        let block = Block { conv, norm: norm_of(recipe, 2)?, from_bytes, shape: recipe.shape.into() };
        Ok((Box::new(ConvolutionOp(Arc::new(block), None)), vec![0]))
    })
}

#[derive(Debug)]
struct Block {
    conv: Conv,
    norm: Norm,
    /// `x / .0 + .1` of bytes, where bytes come in.
    from_bytes: Option<(f32, f32)>,
    shape: TVec<usize>,
}

#[derive(Debug, Clone)]
pub(super) struct ConvolutionOp(Arc<Block>, Option<SharedTeam>);

impl ConvolutionOp {
    pub(super) fn settle(&mut self, team: Option<&SharedTeam>) {
        let conv = &self.0.conv;
        let flops = 2 * 16 * conv.len_in() / 4 * conv.channels_out();
        self.1 = team.filter(|_| flops >= SHARED_FLOPS_MIN).cloned();
    }
}

#[derive(Debug, Clone)]
struct ConvolutionState {
    padded: Vec<f32>,
    results: Results,
}

impl ConvolutionState {
    fn new(op: &ConvolutionOp) -> Self {
        let block = &op.0;
        Self {
            padded: vec![0.0; block.conv.len_padded()],
            results: Results::new(f32::datum_type(), &block.shape),
        }
    }

    fn run(&mut self, op: &ConvolutionOp, inputs: &[TValue]) -> TractResult<TVec<TValue>> {
        let (arch, Block { conv, norm, from_bytes, .. }) = (Arch::new(), &*op.0);
        match from_bytes {
            Some(change) => conv.pad_bytes(arch, slice::<u8>(&inputs[0])?, *change, &mut self.padded),
            None => conv.pad(slice::<f32>(&inputs[0])?, &mut self.padded),
        }
        let (padded, side) = (self.padded.as_slice(), conv.side_out());
        self.results.write(|out: &mut [f32]| {
            let Some(team) = &op.1 else {
                conv.run(arch, padded, 0..side, out);
                return norm.run(arch, out);
            };
            let pieces = Pieces::new(out, ROWS * side * conv.channels_out());
            let mut team = team.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            team.each(pieces.count(), &|index| {
                // SAFETY: a team runs every index once.
                let out = unsafe { pieces.take(index) };
                conv.run(arch, padded, ROWS * index..ROWS * (index + 1), out);
                norm.run(arch, out);
            });
        })
    }
}

stateful_op!(ConvolutionOp, ConvolutionState, CONV);

impl TypedOp for ConvolutionOp {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(f32::fact(&self.0.shape)))
    }

    as_op!();
}
