//! The arithmetic of tick and update, each function once: plain functions on slices, which know nothing of an engine or of a graph.
//!
//! | module | holds |
//! | --- | --- |
//! | [`tick`] | one observation: vectors, weights laid out once |
//! | [`batch`] | an update: batches of rows, forward and backward |
//! | [`team`] | a second thread for a tick, which is not waited for where it is late |

pub mod batch;
mod simd;
pub mod team;
pub mod tick;

/// Runs a loop compiled for the best instruction set of this machine (AVX-512, AVX2 or the baseline).
#[inline(always)]
pub fn vectorised<R>(body: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(body)
}
