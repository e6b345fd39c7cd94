//! Values as distributions over bins that are evenly spaced in symlog space.

use candle_core::{D, Result, Tensor};

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

/// The bins in symlog space; count is odd, so that one of them is 0.
pub fn bins(count: usize) -> impl Iterator<Item = f32> {
    let middle = (count / 2) as f64;
    (0..count).map(move |index| ((index as f64 - middle) / middle * TWO_HOT_LIMIT) as f32)
}

/// Mean of the distribution given by `logits` [..., count] over the [`bins`], as a value: [..., 1].
///
/// `positive` [(count - 1) / 2] are the bins above 0. Bins come in pairs b and -b, so the mean is the sum of b (p(b) - p(-b)):
/// summed in order, the large negative half would cancel the positive one only at the end, and leave its rounding errors behind.
///
/// # Errors
/// Those of candle (shapes, devices).
pub fn two_hot_mean(logits: &Tensor, positive: &Tensor) -> Result<Tensor> {
    let half = positive.dim(0)?;
    let p = softmax(logits)?;
    let below = p.narrow(D::Minus1, 0, half)?.contiguous()?.flip(&[p.rank() - 1])?;
    let above = p.narrow(D::Minus1, half + 1, half)?;
    symexp(&(above - below)?.broadcast_mul(positive)?.sum_keepdim(D::Minus1)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

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
        let bins: Vec<f32> = bins(255).collect();
        assert_eq!((bins[0], bins[127], bins[254]), (-20.0, 0.0, 20.0));
        assert!(bins.iter().zip(bins.iter().rev()).all(|(low, high)| *low == -*high));
    }

    #[test]
    fn the_mean_is_the_probabilities_times_the_bins() {
        let p = [0.1f32, 0.2, 0.3, 0.25, 0.15];
        let logits = Tensor::new(&p, &Device::Cpu).unwrap().log().unwrap();
        let positive = Tensor::from_iter(bins(5).skip(3), &Device::Cpu).unwrap();
        let mean: f32 = bins(5).zip(p).map(|(bin, p)| bin * p).sum();
        let found = two_hot_mean(&logits, &positive).unwrap().to_vec1::<f32>().unwrap()[0];
        assert!((found - (mean.exp() - 1.0)).abs() < 1e-5, "{found}");
        // Of nothing but equal logits exactly 0: what an untrained head says.
        let even = Tensor::zeros(5, candle_core::DType::F32, &Device::Cpu).unwrap();
        assert_eq!(two_hot_mean(&even, &positive).unwrap().to_vec1::<f32>().unwrap(), [0.0]);
    }
}
