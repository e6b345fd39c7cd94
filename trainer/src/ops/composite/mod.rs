//! The same functions as compositions of candle's own operations, each of which has a gradient on every device: what runs on a GPU, and
//! what the fused ops are tested against. (candle's fused `LayerNorm` and last-dimension softmax have no gradient on contiguous
//! inputs, and say nothing about it.)

mod activation;
mod attention;
mod categorical;
mod cell;
mod conv;
mod linear;
mod norm;
mod picture;
mod two_hot;

pub use activation::{log_softmax, sigmoid, softmax};
pub use attention::cross_attention;
pub use categorical::{
    KlBalance, balanced_kl, entropy, log_probs, one_hot_of_best, probs, straight_through_mode,
    straight_through_sample,
};
pub use cell::recurrent_update;
pub use conv::{conv_down, conv_up};
pub use linear::linear;
pub use norm::{layer_norm, layer_norm_silu};
pub use picture::{image_to_float, picture_loss, reconstruction};
pub use two_hot::{symexp, symlog, two_hot_loss, two_hot_mean};
