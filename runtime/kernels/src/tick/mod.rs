//! What the tick spends its time in, written for vector registers. Plain slices in and out; nothing here allocates.
//!
//! | module | computes | bound by |
//! | --- | --- | --- |
//! | [`conv`] | convolution of kernel 4 and stride 2, rows of pixels in, rows of pixels out | arithmetic |
//! | [`matrix`] | a vector times a matrix that was laid out once | memory |
//! | [`table`] | sums of rows of a table | memory |
//! | [`weights`] | how weights lie in memory | |
//! | [`norm`] | LayerNorm and `SiLU` over rows | arithmetic |
//! | [`latents`] | log-probabilities of the categoricals, their classes, their divergence | arithmetic |
//!
//! Instructions are chosen while running: AVX-512, AVX2 with FMA, NEON, or none.

pub mod conv;
pub mod latents;
pub mod matrix;
pub mod norm;
#[cfg(test)]
pub(crate) mod not_finite;
pub mod table;
pub mod weights;
