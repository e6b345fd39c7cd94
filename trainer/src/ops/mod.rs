//! The differentiable primitives of the model, behind plain functions.
//!
//! On the CPU, f32 tensors take fused kernels with hand-written gradients; everything else takes [`composite`], which is made of
//! candle's own operations. Both give the same values and gradients up to rounding, which the tests of each op check.
//! Images and feature maps are channels-last, `[B, H, W, C]`.
//!
//! | module | holds |
//! | --- | --- |
//! | `composite` | every op out of candle's operations: the GPU path, and the tests' oracle |
//! | `kernels` | the arithmetic of the fused ops, on slices |
//! | `node` | fused ops in candle's graph |
//! | `rows` | ops that act on each row alone |
//!
//! The same inputs give the same bits, run after run, for a fixed number of threads.

mod activation;
mod adam;
mod attention;
mod categorical;
mod cell;
pub mod composite;
mod conv;
mod conv_pass;
mod conv_stack;
mod gemm;
mod linear;
mod memory;
mod node;
mod noise;
mod norm;
mod parallel;
mod picture;
mod reconstruction;
mod rows;
mod two_hot;

#[cfg(test)]
mod check;
#[cfg(test)]
mod oracle_tests;

pub use activation::{log_softmax, sigmoid, softmax};
pub use adam::{AdamStep, adam_step, sum_of_squares};
pub use attention::cross_attention;
pub use categorical::{
    KlBalance, balanced_kl, entropy, log_probs, one_hot_of_best, probs, straight_through_mode,
    straight_through_sample,
};
pub use cell::{recurrent_cell, recurrent_update};
pub use conv::{conv_down, conv_down_stack, conv_up, conv_up_stack};
pub use conv_stack::ConvLayer;
pub use linear::linear;
pub use memory::{keep_freed_memory, return_freed_memory};
pub use noise::{gumbel, normal};
pub use norm::{layer_norm, layer_norm_silu};
pub use parallel::{in_parallel, leave_threads_to_ops, shares_of};
pub use picture::{image_to_float, picture_loss};
pub use reconstruction::reconstruction_loss;
pub use two_hot::{TWO_HOT_LIMIT, bins, bins_tensor, symexp, symlog, two_hot_loss, two_hot_mean};
