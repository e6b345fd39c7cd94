use candle_core::{D, Result, Tensor};

use super::composite;
use super::node::{Backward, floats, fusible, mismatch, record_one};
use super::parallel;
use rcwm_kernels::batch::norm::{self, Norm, NormGrads};

/// Numbers below which a second thread costs more than it gives.
pub(super) const SHARE_NUMBERS_MIN: usize = 32_768;

/// LayerNorm over the last dimension, biased variance: `(x - mean) / sqrt(var + eps) * weight + bias`.
///
/// Cost a number: 8 flops and 8 bytes forward, 20 flops and 12 bytes backward.
pub fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64) -> Result<Tensor> {
    if fusible(&[x, weight, bias]) {
        fused("layer-norm", x, weight, bias, eps, false)
    } else {
        composite::layer_norm(x, weight, bias, eps)
    }
}

/// LayerNorm, then `SiLU`: what follows every hidden layer.
///
/// Cost a number: 25 flops and 8 bytes forward, 40 flops and 12 bytes backward.
pub fn layer_norm_silu(x: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64) -> Result<Tensor> {
    if fusible(&[x, weight, bias]) {
        fused("layer-norm-silu", x, weight, bias, eps, true)
    } else {
        composite::layer_norm_silu(x, weight, bias, eps)
    }
}

fn fused(
    op: &'static str,
    x: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    eps: f64,
    silu: bool,
) -> Result<Tensor> {
    let width = x.dim(D::Minus1)?;
    for parameter in [weight, bias] {
        if parameter.dims() != [width] || width == 0 {
            return mismatch(op, x, parameter);
        }
    }
    let x = x.contiguous()?;
    let kept =
        Kept { op, x: x.detach(), weight: weight.detach(), bias: bias.detach(), eps: eps as f32, silu };
    let out = kept.forward(width)?;
    record_one(&[&x, weight, bias], out, x.shape(), kept)
}

struct Kept {
    op: &'static str,
    x: Tensor,
    weight: Tensor,
    bias: Tensor,
    eps: f32,
    silu: bool,
}

impl Kept {
    fn forward(&self, width: usize) -> Result<Vec<f32>> {
        let (x, gain, shift) =
            (floats(self.op, &self.x)?, floats(self.op, &self.weight)?, floats(self.op, &self.bias)?);
        let norm = Norm { gain: &gain, shift: &shift, eps: self.eps, silu: self.silu };
        let mut out = vec![0.0; x.len()];
        let shares = parallel::shares(x.len() / width, SHARE_NUMBERS_MIN / width);
        let parts = parallel::split(&mut out, &shares, width);
        let x = &*x;
        parallel::each(&shares, parts, |share, part| {
            norm::forward(&x[share.start * width..share.end * width], norm, part);
        });
        Ok(out)
    }
}

impl Backward for Kept {
    fn name(&self) -> &'static str {
        self.op
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None; 3]) };
        let (x, gain, shift) =
            (floats(self.op, &self.x)?, floats(self.op, &self.weight)?, floats(self.op, &self.bias)?);
        let d_out = floats(self.op, grad)?;
        let norm = Norm { gain: &gain, shift: &shift, eps: self.eps, silu: self.silu };
        let width = gain.len();
        let mut dx = vec![0.0; x.len()];
        let shares = parallel::shares(x.len() / width, SHARE_NUMBERS_MIN / width);
        let mut sums = vec![NormGrads::new(width); shares.len()];
        let (x, d_out) = (&*x, &*d_out);
        let parts = parallel::split(&mut dx, &shares, width).into_iter().zip(&mut sums);
        parallel::each(&shares, parts, |share, (dx, sums)| {
            let range = share.start * width..share.end * width;
            norm::backward(&x[range.clone()], norm, &d_out[range], dx, sums);
        });
        let total = NormGrads::total(sums, width);
        let dx = Tensor::from_vec(dx, self.x.shape(), self.x.device())?;
        let [gain, shift] = into_tensors(total)?;
        Ok(vec![Some(dx), Some(gain), Some(shift)])
    }
}

/// Gradients of gain and shift, [width].
pub(super) fn into_tensors(grads: NormGrads) -> Result<[Tensor; 2]> {
    let tensor = |values: Vec<f32>| {
        let width = values.len();
        Tensor::from_vec(values, width, &candle_core::Device::Cpu)
    };
    Ok([tensor(grads.gain)?, tensor(grads.shift)?])
}
