use candle_core::{Result, Tensor};

use super::composite;
use super::conv_pass::Direction;
use super::conv_stack::{ConvLayer, stack};
use super::node::fusible;

/// Halves the sides of a feature map: `x` [B, H, W, C], `weight` [out, C, 4, 4], gives [B, H/2, W/2, out].
///
/// Cost: `8 B H W C out` flops forward, twice that backward (once for an `x` without gradient).
///
/// # Errors
/// Those of candle (shapes, devices); H and W must be even.
pub fn conv_down(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    conv_down_stack(x, &[ConvLayer::bare(weight)])
}

/// Doubles the sides of a feature map (transposed convolution): `x` [B, H, W, C], `weight` [C, out, 4, 4], gives
/// [B, 2H, 2W, out].
///
/// Cost: `32 B H W C out` flops forward, half more where there are at most 4 outputs; twice that backward.
pub fn conv_up(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    conv_up_stack(x, &[ConvLayer::bare(weight)])
}

/// [`conv_down`] layer after layer, with what follows each. An image goes through all layers while it is in the cache, and
/// gradients between layers are never seen by candle.
pub fn conv_down_stack(x: &Tensor, layers: &[ConvLayer<'_>]) -> Result<Tensor> {
    if layers.iter().all(|layer| fusible(&[x, layer.weight])) {
        return stack(Direction::Down, x, layers);
    }
    layers.iter().try_fold(x.clone(), |x, layer| layer.finish(composite::conv_down(&x, layer.weight)?))
}

/// [`conv_up`] layer after layer, as [`conv_down_stack`].
pub fn conv_up_stack(x: &Tensor, layers: &[ConvLayer<'_>]) -> Result<Tensor> {
    if layers.iter().all(|layer| fusible(&[x, layer.weight])) {
        return stack(Direction::Up, x, layers);
    }
    layers.iter().try_fold(x.clone(), |x, layer| layer.finish(composite::conv_up(&x, layer.weight)?))
}
