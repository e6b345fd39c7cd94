use candle_core::{D, DType, Result, Tensor};

use super::{log_softmax, softmax};

/// `sign(x) ln(1 + |x|)`: squeezes values of any scale.
pub fn symlog(x: &Tensor) -> Result<Tensor> {
    x.sign()? * (x.abs()? + 1.0)?.log()?
}

/// The inverse of [`symlog`]: `sign(x) (exp(|x|) - 1)`.
pub fn symexp(x: &Tensor) -> Result<Tensor> {
    x.sign()? * (x.abs()?.exp()? - 1.0)?
}

/// Mean of the distribution given by `logits` [..., count] over `bins` [count], as a value: [..., 1].
pub fn two_hot_mean(logits: &Tensor, bins: &Tensor) -> Result<Tensor> {
    let half = bins.dim(0)? / 2;
    let p = softmax(logits)?;
    // In pairs, see [`crate::ops::two_hot_mean`].
    let below = p.narrow(D::Minus1, 0, half)?.contiguous()?.flip(&[p.rank() - 1])?;
    let above = p.narrow(D::Minus1, half + 1, half)?;
    let positive = bins.narrow(0, half + 1, half)?;
    symexp(&(above - below)?.broadcast_mul(&positive)?.sum_keepdim(D::Minus1)?)
}

/// See [`crate::ops::two_hot_loss`].
pub fn two_hot_loss(logits: &Tensor, bins: &Tensor, targets: &Tensor) -> Result<Tensor> {
    let targets = targets.detach().unsqueeze(D::Minus1)?; // [..., 1]
    let count = bins.dim(0)?;
    let width = [targets.dims(), &[]].concat();
    let wide = [&width[..width.len() - 1], &[count]].concat();
    // Each bin's weight falls linearly from 1 at the bin to 0 at its neighbours.
    let first = bins.get(0)?.to_scalar::<f32>()?;
    let spacing = f64::from(bins.get(1)?.to_scalar::<f32>()? - first);
    let last = bins.get(count - 1)?.to_scalar::<f32>()?;
    let inside = targets.clamp(f64::from(first), f64::from(last))?.broadcast_as(wide)?;
    let distance = (inside.broadcast_sub(bins)?.abs()? / spacing)?;
    let weights = distance.affine(-1.0, 1.0)?.maximum(0.0)?.to_dtype(DType::F32)?;
    (weights * log_softmax(logits)?)?.sum(D::Minus1)?.neg()
}
