//! Convolution of kernel 4 and stride 2, norm and `SiLU`, channels last; reads floats or bytes.

use std::sync::PoisonError;

use pulp::Arch;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use super::build::{Context, own};
use super::memory::{Pieces, slice};
use super::norm::norm_of;
use super::own::{Compute, Own};
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
        Ok((Own::boxed(block), vec![0]))
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

    fn is_worth_sharing(&self) -> bool {
        2 * 16 * self.conv.len_in() / 4 * self.conv.channels_out() >= SHARED_FLOPS_MIN
    }

    fn run(
        &self,
        inputs: &[TValue],
        padded: &mut Vec<f32>,
        team: Option<&SharedTeam>,
        out: &mut [f32],
    ) -> TractResult<()> {
        let (arch, Self { conv, norm, from_bytes, .. }) = (Arch::new(), self);
        match from_bytes {
            Some(change) => conv.pad_bytes(arch, slice(&inputs[0])?, *change, padded),
            None => conv.pad(slice(&inputs[0])?, padded),
        }
        let (padded, side) = (padded.as_slice(), conv.side_out());
        let Some(team) = team else {
            conv.run(arch, padded, 0..side, out);
            norm.run(arch, out);
            return Ok(());
        };
        let pieces = Pieces::new(out, ROWS * side * conv.channels_out());
        team.lock().unwrap_or_else(PoisonError::into_inner).each(pieces.count(), &|index| {
            // SAFETY: a team runs every index once.
            let out = unsafe { pieces.take(index) };
            conv.run(arch, padded, ROWS * index..ROWS * (index + 1), out);
            norm.run(arch, out);
        });
        Ok(())
    }
}
