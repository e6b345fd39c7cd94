//! The differentiable primitives of the model, behind plain functions.
//!
//! Everything here is a composition of candle's own operations, each of which has a gradient on every device. (candle's
//! fused `LayerNorm` and last-dimension softmax have none on contiguous inputs, and say nothing about it.)
//! Images and feature maps are channels-last, `[B, H, W, C]`: a convolution is then one matrix product.

mod activation;
mod attention;
mod categorical;
mod cell;
mod conv;
mod linear;
mod norm;
mod two_hot;

pub use activation::{log_softmax, sigmoid, softmax};
pub use attention::cross_attention;
pub use categorical::{log_probs, one_hot_of_best, probs, straight_through_mode, straight_through_sample};
pub use cell::recurrent_update;
pub use conv::{conv_down, conv_up};
pub use linear::linear;
pub use norm::{layer_norm, layer_norm_silu};
pub use two_hot::{TWO_HOT_LIMIT, bins, symexp, symlog, two_hot_mean};
