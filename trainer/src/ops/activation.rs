use std::ops::Range;

use candle_core::{Result, Tensor};

use super::composite;
use super::node::fusible;
use super::rows::{self, RowOp};
use rcwm_kernels::batch::categorical::{self, Output};
use rcwm_kernels::{batch::math, vectorised};

/// `1 / (1 + exp(-x))`: no overflow and no NaN gradient for any x.
///
/// Cost a number: 15 flops and 8 bytes forward, 20 flops and 12 bytes backward.
pub fn sigmoid(x: &Tensor) -> Result<Tensor> {
    if fusible(&[x]) && x.rank() > 0 { rows::apply(x, x.shape(), Sigmoid) } else { composite::sigmoid(x) }
}

/// Softmax over the last dimension.
///
/// Cost a number: 25 flops and 8 bytes forward, 30 flops and 12 bytes backward.
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    distribution(x, 0.0, Output::Probabilities).unwrap_or_else(|| composite::softmax(x))
}

/// Logarithm of the softmax over the last dimension. Cost as [`softmax`].
pub fn log_softmax(x: &Tensor) -> Result<Tensor> {
    distribution(x, 0.0, Output::Logarithms).unwrap_or_else(|| composite::log_softmax(x))
}

/// Fused probabilities or their logarithms; none where the composite must do it.
pub(super) fn distribution(logits: &Tensor, unimix: f64, output: Output) -> Option<Result<Tensor>> {
    let op = Distribution { unimix: unimix as f32, output };
    fusible(&[logits]).then(|| rows::apply(logits, logits.shape(), op))
}

struct Distribution {
    unimix: f32,
    output: Output,
}

impl RowOp for Distribution {
    const NAME: &'static str = "categorical-distribution";

    fn out_width(&self, width: usize) -> usize {
        width
    }

    fn forward(&self, x: &[f32], width: usize, _: Range<usize>, out: &mut [f32]) {
        categorical::distribution(x, width, self.unimix, self.output, out);
    }

    fn backward(&self, x: &[f32], width: usize, _: Range<usize>, d_out: &[f32], dx: &mut [f32]) {
        categorical::distribution_backward(x, width, self.unimix, self.output, d_out, dx);
    }
}

struct Sigmoid;

impl RowOp for Sigmoid {
    const NAME: &'static str = "sigmoid";

    fn out_width(&self, width: usize) -> usize {
        width
    }

    fn forward(&self, x: &[f32], _: usize, _: Range<usize>, out: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || {
                for (out, x) in out.iter_mut().zip(x) {
                    *out = math::sigmoid(*x);
                }
            },
        );
    }

    fn backward(&self, x: &[f32], _: usize, _: Range<usize>, d_out: &[f32], dx: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || {
                for ((dx, x), d) in dx.iter_mut().zip(x).zip(d_out) {
                    let y = math::sigmoid(*x);
                    *dx = d * y * (1.0 - y);
                }
            },
        );
    }
}
