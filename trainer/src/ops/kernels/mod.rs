//! The arithmetic behind the fused ops: plain functions on slices, which know nothing of candle.
//!
//! Rows are the unit: `[rows, width]`, row after row. Backward functions compute what they need of the forward pass again from its
//! inputs, where that is cheaper than to have kept it: a few flops a number against a trip to memory.

pub mod attention;
pub mod categorical;
pub mod conv;
pub mod gates;
pub mod gemm;
pub mod math;
pub mod norm;
mod norm_parameters;
pub mod norm_vector;
pub mod parallel;
pub mod picture;
pub mod tile;

/// Runs a loop compiled for the best instruction set of this machine (AVX-512, AVX2 or the baseline).
#[inline(always)]
pub fn vectorised<R>(body: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(body)
}
