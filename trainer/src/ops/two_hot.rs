//! Values as distributions over bins that are evenly spaced in symlog space.

use candle_core::{D, Device, Result, Tensor};

use super::softmax;

/// The bins reach from `-TWO_HOT_LIMIT` to `TWO_HOT_LIMIT` in symlog space.
pub const TWO_HOT_LIMIT: f64 = 20.0;

/// `sign(x) ln(1 + |x|)`: squeezes values of any scale.
///
/// # Errors
/// Those of candle (shapes, devices).
pub fn symlog(x: &Tensor) -> Result<Tensor> {
    x.sign()? * (x.abs()? + 1.0)?.log()?
}

/// The inverse of [`symlog`]: `sign(x) (exp(|x|) - 1)`.
///
/// # Errors
/// Those of candle (shapes, devices).
pub fn symexp(x: &Tensor) -> Result<Tensor> {
    x.sign()? * (x.abs()?.exp()? - 1.0)?
}

/// The bins in symlog space, [count]; count is odd, so that one of them is 0.
///
/// # Errors
/// Those of candle (devices).
pub fn bins(count: usize, device: &Device) -> Result<Tensor> {
    let middle = (count / 2) as f64;
    let bin = |index: usize| ((index as f64 - middle) / middle * TWO_HOT_LIMIT) as f32;
    Tensor::from_iter((0..count).map(bin), device)
}

/// Mean of the distribution given by `logits` [..., count] over `bins` [count], as a value: [..., 1].
///
/// # Errors
/// Those of candle (shapes, devices).
pub fn two_hot_mean(logits: &Tensor, bins: &Tensor) -> Result<Tensor> {
    symexp(&softmax(logits)?.broadcast_mul(bins)?.sum_keepdim(D::Minus1)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn symexp_undoes_symlog() {
        let x = Tensor::new(&[-1000f32, -0.5, 0.0, 2.0, 300.0], &Device::Cpu).unwrap();
        let back = symexp(&symlog(&x).unwrap()).unwrap().to_vec1::<f32>().unwrap();
        for (found, expected) in back.iter().zip(x.to_vec1::<f32>().unwrap()) {
            assert!((found - expected).abs() <= 1e-4 * expected.abs().max(1.0), "{found} {expected}");
        }
    }

    #[test]
    fn the_bins_are_symmetric_around_zero() {
        let bins = bins(255, &Device::Cpu).unwrap().to_vec1::<f32>().unwrap();
        assert_eq!((bins[0], bins[127], bins[254]), (-20.0, 0.0, 20.0));
        assert!(bins.iter().zip(bins.iter().rev()).all(|(low, high)| *low == -*high));
    }
}
