use candle_core::{D, Result, Tensor};

use super::composite;
use super::node::{Backward, floats, fusible, mismatch, record_one};
use super::norm::SHARE_NUMBERS_MIN;
use super::parallel;
use rcwm_kernels::batch::gates;
use rcwm_kernels::batch::norm::{Norm, NormGrads};

/// The gates of the recurrent cell: `gates` [B, 3d] holds `reset, cand, update` after their LayerNorm; gives
/// `h' = update * cand + (1 - update) * h` [B, d], where `cand = tanh(sigmoid(reset) * cand)` and
/// `update = sigmoid(update - 1)`: a new cell keeps what it knows.
///
/// Cost a number of h: 70 flops and 20 bytes forward, 90 and 36 backward.
pub fn recurrent_update(gates: &Tensor, h: &Tensor) -> Result<Tensor> {
    if !fusible(&[gates, h]) {
        return composite::recurrent_update(gates, h);
    }
    let (gates, h) = (gates.contiguous()?, h.contiguous()?);
    let d = width("recurrent-update", &gates, &h)?;
    let mut next = vec![0.0; h.elem_count()];
    {
        let (gates, h) = (floats("recurrent-update", &gates)?, floats("recurrent-update", &h)?);
        gates::update(&gates, &h, d, &mut next);
    }
    let kept = Update { gates: gates.detach(), h: h.detach() };
    record_one(&[&gates, &h], next, h.shape(), kept)
}

/// The recurrent cell after its linear layer: LayerNorm of `pre` [B, 3d], then [`recurrent_update`].
///
/// Cost a number of h: 100 flops and 20 bytes forward, 180 and 40 backward.
pub fn recurrent_cell(pre: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64, h: &Tensor) -> Result<Tensor> {
    if !fusible(&[pre, weight, bias, h]) {
        return composite::recurrent_update(&composite::layer_norm(pre, weight, bias, eps)?, h);
    }
    let (pre, h) = (pre.contiguous()?, h.contiguous()?);
    let d = width("recurrent-cell", &pre, &h)?;
    for parameter in [weight, bias] {
        if parameter.dims() != [3 * d] {
            return mismatch("recurrent-cell", &pre, parameter);
        }
    }
    let kept = Cell {
        pre: pre.detach(),
        weight: weight.detach(),
        bias: bias.detach(),
        h: h.detach(),
        eps: eps as f32,
    };
    let next = kept.forward(d)?;
    record_one(&[&pre, weight, bias, &h], next, h.shape(), kept)
}

fn width(op: &'static str, gates: &Tensor, h: &Tensor) -> Result<usize> {
    let d = h.dim(D::Minus1)?;
    if gates.dim(D::Minus1)? != 3 * d || gates.elem_count() != 3 * h.elem_count() || d == 0 {
        return mismatch(op, gates, h);
    }
    Ok(d)
}

struct Update {
    gates: Tensor,
    h: Tensor,
}

impl Backward for Update {
    fn name(&self) -> &'static str {
        "recurrent-update"
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None; 2]) };
        let (gates, h) = (floats(self.name(), &self.gates)?, floats(self.name(), &self.h)?);
        let (mut d_gates, mut dh) = (vec![0.0; gates.len()], vec![0.0; h.len()]);
        let d = self.h.dim(D::Minus1)?;
        gates::update_backward(&gates, &h, d, &floats(self.name(), grad)?, &mut d_gates, &mut dh);
        let device = self.h.device();
        let d_gates = Tensor::from_vec(d_gates, self.gates.shape(), device)?;
        Ok(vec![Some(d_gates), Some(Tensor::from_vec(dh, self.h.shape(), device)?)])
    }
}

struct Cell {
    pre: Tensor,
    weight: Tensor,
    bias: Tensor,
    h: Tensor,
    eps: f32,
}

impl Cell {
    fn forward(&self, d: usize) -> Result<Vec<f32>> {
        let (pre, h) = (floats(self.name(), &self.pre)?, floats(self.name(), &self.h)?);
        let (gain, shift) = (floats(self.name(), &self.weight)?, floats(self.name(), &self.bias)?);
        let norm = Norm { gain: &gain, shift: &shift, eps: self.eps, silu: false };
        let mut next = vec![0.0; h.len()];
        let shares = parallel::shares(h.len() / d, SHARE_NUMBERS_MIN / (3 * d));
        let (pre, h) = (&*pre, &*h);
        parallel::each(&shares, parallel::split(&mut next, &shares, d), |share, next| {
            let (from, to) = (share.start * d, share.end * d);
            gates::cell(&pre[3 * from..3 * to], norm, &h[from..to], next);
        });
        Ok(next)
    }
}

impl Backward for Cell {
    fn name(&self) -> &'static str {
        "recurrent-cell"
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None; 4]) };
        let (pre, h) = (floats(self.name(), &self.pre)?, floats(self.name(), &self.h)?);
        let (gain, shift) = (floats(self.name(), &self.weight)?, floats(self.name(), &self.bias)?);
        let d_next = floats(self.name(), grad)?;
        let norm = Norm { gain: &gain, shift: &shift, eps: self.eps, silu: false };
        let d = gain.len() / 3;
        let (mut d_pre, mut dh) = (vec![0.0; pre.len()], vec![0.0; h.len()]);
        let shares = parallel::shares(h.len() / d, SHARE_NUMBERS_MIN / (3 * d));
        let mut sums = vec![NormGrads::new(3 * d); shares.len()];
        let (pre, h, d_next) = (&*pre, &*h, &*d_next);
        let parts = parallel::split(&mut d_pre, &shares, 3 * d).into_iter();
        let parts = parts.zip(parallel::split(&mut dh, &shares, d)).zip(&mut sums);
        parallel::each(&shares, parts, |share, ((d_pre, dh), sums)| {
            let (from, to) = (share.start * d, share.end * d);
            let (pre, h, d_next) = (&pre[3 * from..3 * to], &h[from..to], &d_next[from..to]);
            gates::cell_backward(pre, norm, h, d_next, d_pre, dh, sums);
        });
        let [gain, shift] = super::norm::into_tensors(NormGrads::total(sums, 3 * d))?;
        let device = self.h.device();
        let d_pre = Tensor::from_vec(d_pre, self.pre.shape(), device)?;
        let dh = Tensor::from_vec(dh, self.h.shape(), device)?;
        Ok(vec![Some(d_pre), Some(gain), Some(shift), Some(dh)])
    }
}
