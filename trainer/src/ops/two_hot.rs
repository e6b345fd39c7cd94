//! Values as distributions over bins that are evenly spaced in symlog space.

use std::ops::Range;

use candle_core::{Device, Result, Tensor};

use super::composite;
use super::node::{floats, fusible, mismatch};
use super::rows::{self, RowOp};
use rcwm_kernels::batch::categorical;

pub use super::composite::{symexp, symlog};

/// The bins reach from `-TWO_HOT_LIMIT` to `TWO_HOT_LIMIT` in symlog space.
pub const TWO_HOT_LIMIT: f64 = 20.0;

/// The bins in symlog space; count is odd, so that one of them is 0.
pub fn bins(count: usize) -> impl Iterator<Item = f32> {
    let middle = (count / 2) as f64;
    (0..count).map(move |index| ((index as f64 - middle) / middle * TWO_HOT_LIMIT) as f32)
}

/// The [`bins`] as a tensor, [count].
pub fn bins_tensor(count: usize, device: &Device) -> Result<Tensor> {
    Tensor::from_iter(bins(count), device)
}

/// Mean of the distribution given by `logits` [..., count] over `bins` [count], as a value: [..., 1].
///
/// Bins come in pairs b and -b, so the mean is the sum of b (p(b) - p(-b)): summed in order, the large negative half would
/// cancel the positive one only at the end, and leave its rounding errors behind.
///
/// Cost a logit: 25 flops and 4 bytes forward, 30 flops and 8 bytes backward.
pub fn two_hot_mean(logits: &Tensor, bins: &Tensor) -> Result<Tensor> {
    if !fusible(&[logits, bins]) {
        return composite::two_hot_mean(logits, bins);
    }
    let bins = checked(Mean::NAME, logits, bins)?;
    let shape = [&logits.dims()[..logits.rank() - 1], &[1]].concat();
    symexp(&rows::apply(logits, shape, Mean { bins })?)
}

/// Cross-entropy of `logits` [..., count] with the two-hot distributions of `targets` [...], which are given in the space of the evenly spaced
/// `bins` [count]: [...]. The targets get no gradient.
///
/// Cost a logit: 25 flops and 4 bytes forward, 25 flops and 8 bytes backward.
pub fn two_hot_loss(logits: &Tensor, bins: &Tensor, targets: &Tensor) -> Result<Tensor> {
    let lead = &logits.dims()[..logits.rank().saturating_sub(1)];
    if targets.dims() != lead {
        return mismatch(Loss::NAME, logits, targets);
    }
    if !fusible(&[logits, bins, targets]) {
        return composite::two_hot_loss(logits, bins, targets);
    }
    let bins = checked(Loss::NAME, logits, bins)?;
    let targets = targets.detach().contiguous()?;
    let targets = floats(Loss::NAME, &targets)?.to_vec();
    rows::apply(logits, lead, Loss { bins, targets })
}

/// The bins, at least two and as many as logits in a row.
fn checked(op: &'static str, logits: &Tensor, bins: &Tensor) -> Result<Vec<f32>> {
    let count = bins.elem_count();
    if logits.dims().last() != Some(&count) || count < 2 {
        return mismatch(op, logits, bins);
    }
    Ok(floats(op, &bins.contiguous()?)?.to_vec())
}

struct Mean {
    bins: Vec<f32>,
}

impl RowOp for Mean {
    const NAME: &'static str = "two-hot-mean";

    fn out_width(&self, _: usize) -> usize {
        1
    }

    fn forward(&self, x: &[f32], _: usize, _: Range<usize>, out: &mut [f32]) {
        categorical::mean(x, &self.bins, out);
    }

    fn backward(&self, x: &[f32], _: usize, _: Range<usize>, d_out: &[f32], dx: &mut [f32]) {
        categorical::mean_backward(x, &self.bins, d_out, dx);
    }
}

struct Loss {
    bins: Vec<f32>,
    targets: Vec<f32>,
}

impl RowOp for Loss {
    const NAME: &'static str = "two-hot-loss";

    fn out_width(&self, _: usize) -> usize {
        1
    }

    fn forward(&self, x: &[f32], _: usize, rows: Range<usize>, out: &mut [f32]) {
        categorical::two_hot_loss(x, &self.bins, &self.targets[rows], out);
    }

    fn backward(&self, x: &[f32], _: usize, rows: Range<usize>, d_out: &[f32], dx: &mut [f32]) {
        categorical::two_hot_loss_backward(x, &self.bins, &self.targets[rows], d_out, dx);
    }
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
        let bins = bins_tensor(255, &Device::Cpu).unwrap().to_vec1::<f32>().unwrap();
        assert_eq!((bins[0], bins[127], bins[254]), (-20.0, 0.0, 20.0));
        assert!(bins.iter().zip(bins.iter().rev()).all(|(low, high)| *low == -*high));
    }
}
