use candle_core::{D, Result, Tensor};

use crate::ops::{self, TWO_HOT_LIMIT};

/// Values [..., 1] as weights [..., count] of the two nearest of `count` bins in symlog space, which sum to 1 and whose mean is
/// the value; values beyond the outermost bin count as that bin. Without gradient.
///
/// # Errors
/// Those of candle.
pub fn two_hot(values: &Tensor, count: usize) -> Result<Tensor> {
    let half = (count / 2) as f64;
    let places = Tensor::arange(-half as f32, half as f32 + 1.0, values.device())?;
    let place = (ops::symlog(&values.detach())? * (half / TWO_HOT_LIMIT))?.clamp(-half, half)?;
    // The bins are evenly spaced: a bin's weight falls linearly to 0 on the way to its neighbours.
    place.broadcast_sub(&places)?.abs()?.affine(-1.0, 1.0)?.relu()
}

/// Cross-entropy of the distribution given by `logits` [..., count] against the weights `target` [..., count]: [...].
///
/// # Errors
/// Those of candle.
pub fn cross_entropy(logits: &Tensor, target: &Tensor) -> Result<Tensor> {
    (target * ops::log_softmax(logits)?)?.sum(D::Minus1)?.neg()
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    #[test]
    fn two_neighbours_share_the_weight_and_their_mean_is_the_value() {
        let device = Device::Cpu;
        let bins = (Tensor::arange(-127f32, 128f32, &device).unwrap() * (TWO_HOT_LIMIT / 127.0)).unwrap();
        let values = [-3000f32, -0.3, 0.0, 0.05, 7.0, 1e9];
        let weights = two_hot(&Tensor::new(&values, &device).unwrap().unsqueeze(1).unwrap(), 255).unwrap();
        let means = ops::symexp(&weights.broadcast_mul(&bins).unwrap().sum(1).unwrap()).unwrap();
        let (rows, means) = (weights.to_vec2::<f32>().unwrap(), means.to_vec1::<f32>().unwrap());
        for ((row, mean), value) in rows.iter().zip(&means).zip(values) {
            assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{value}");
            assert!(row.iter().filter(|weight| **weight > 0.0).count() <= 2, "{value}");
            let expected = value.min(20f32.exp() - 1.0);
            assert!((mean - expected).abs() <= 1e-4 * expected.abs().max(0.1), "{mean} {expected}");
        }
    }
}
