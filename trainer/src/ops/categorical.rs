use std::ops::Range;

use candle_core::{Result, Tensor};

use super::activation::distribution;
use super::composite;
use super::node::{Backward, floats, fusible, mismatch, record};
use super::rows::{self, RowOp};
use rcwm_kernels::batch::categorical::{self, Divergence, Output};

pub use super::composite::{KlBalance, one_hot_of_best};

/// Class probabilities with a share of the uniform distribution mixed in: `(1 - u) softmax(logits) + u / m`.
///
/// Cost a number: 25 flops and 8 bytes forward, 30 flops and 12 bytes backward.
pub fn probs(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    distribution(logits, unimix, Output::Probabilities).unwrap_or_else(|| composite::probs(logits, unimix))
}

/// Logarithm of [`probs`]. Cost: 20 flops a number more.
pub fn log_probs(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    distribution(logits, unimix, Output::Logarithms).unwrap_or_else(|| composite::log_probs(logits, unimix))
}

/// A one-hot sample whose gradient passes through the probabilities: `sample + p - sg(p)`.
///
/// `gumbel` is added to the log-probabilities before the argmax, which draws from the distribution; without it the
/// sample is the most probable class.
///
/// Cost a number: 45 flops and 12 bytes forward, 30 flops and 12 bytes backward.
pub fn straight_through_sample(logits: &Tensor, unimix: f64, gumbel: Option<&Tensor>) -> Result<Tensor> {
    if !fusible(&[logits, gumbel.unwrap_or(logits)]) {
        return composite::straight_through_sample(logits, unimix, gumbel);
    }
    if let Some(gumbel) = gumbel.filter(|gumbel| gumbel.dims() != logits.dims()) {
        return mismatch(StraightThrough::NAME, logits, gumbel);
    }
    let noise = gumbel.map(|gumbel| gumbel.detach().contiguous()).transpose()?;
    let noise = noise.as_ref().map(|noise| floats(StraightThrough::NAME, noise)).transpose()?;
    let gradient_of = Output::Probabilities;
    let op =
        StraightThrough { unimix: unimix as f32, noise: noise.as_deref().map(<[f32]>::to_vec), gradient_of };
    rows::apply(logits, logits.shape(), op)
}

/// The most probable class, with a gradient through the log-probabilities: `mode + log p - sg(log p)`.
pub fn straight_through_mode(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    if !fusible(&[logits]) {
        return composite::straight_through_mode(logits, unimix);
    }
    let op = StraightThrough { unimix: unimix as f32, noise: None, gradient_of: Output::Logarithms };
    rows::apply(logits, logits.shape(), op)
}

struct StraightThrough {
    unimix: f32,
    noise: Option<Vec<f32>>,
    gradient_of: Output,
}

impl RowOp for StraightThrough {
    const NAME: &'static str = "straight-through-sample";

    fn out_width(&self, width: usize) -> usize {
        width
    }

    fn forward(&self, x: &[f32], width: usize, rows: Range<usize>, out: &mut [f32]) {
        let noise = self.noise.as_ref().map(|noise| &noise[rows.start * width..rows.end * width]);
        categorical::sample(x, width, self.unimix, noise, out);
    }

    fn backward(&self, x: &[f32], width: usize, _: Range<usize>, d_out: &[f32], dx: &mut [f32]) {
        categorical::distribution_backward(x, width, self.unimix, self.gradient_of, d_out, dx);
    }
}

/// Entropy of the distribution of each row: `logits` [..., m] to [...].
///
/// Cost a number: 45 flops and 4 bytes forward, 50 flops and 8 bytes backward.
pub fn entropy(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    if !fusible(&[logits]) {
        return composite::entropy(logits, unimix);
    }
    rows::apply(logits, &logits.dims()[..logits.rank() - 1], Entropy { unimix: unimix as f32 })
}

struct Entropy {
    unimix: f32,
}

impl RowOp for Entropy {
    const NAME: &'static str = "categorical-entropy";

    fn out_width(&self, _: usize) -> usize {
        1
    }

    fn forward(&self, x: &[f32], width: usize, _: Range<usize>, out: &mut [f32]) {
        categorical::entropy(x, width, self.unimix, out);
    }

    fn backward(&self, x: &[f32], width: usize, _: Range<usize>, d_out: &[f32], dx: &mut [f32]) {
        categorical::entropy_backward(x, width, self.unimix, d_out, dx);
    }
}

/// `prior_scale max(free, KL[sg(q)||p]) + posterior_scale max(free, KL[q||sg(p)])` of each row, and the divergence itself without
/// gradient; logits [..., n, m] of posterior q and prior p, results [...]. Divergences are summed over the n categoricals, then clipped.
///
/// Cost a logit: 100 flops and 8 bytes forward, 130 flops and 16 bytes backward.
pub fn balanced_kl(q: &Tensor, p: &Tensor, unimix: f64, balance: KlBalance) -> Result<(Tensor, Tensor)> {
    if q.dims() != p.dims() || q.rank() < 2 {
        return mismatch(OP_KL, q, p);
    }
    if !fusible(&[q, p]) {
        return composite::balanced_kl(q, p, unimix, balance);
    }
    let (q, p) = (q.contiguous()?, p.contiguous()?);
    let (lead, last) = q.dims().split_at(q.rank() - 2);
    let divergence = Divergence { categoricals: last[0], classes: last[1], unimix: unimix as f32 };
    let mut values = vec![0.0; lead.iter().product()];
    divergence.forward(&floats(OP_KL, &q)?, &floats(OP_KL, &p)?, &mut values);
    let scale = (balance.prior_scale + balance.posterior_scale) as f32;
    let losses = values.iter().map(|value| scale * value.max(balance.free as f32)).collect();
    let kl = Tensor::from_vec(values.clone(), lead, q.device())?;
    let kept = Kl { divergence, balance, values, q: q.detach(), p: p.detach() };
    let mut losses = record(&[&q, &p], vec![(losses, lead.into())], kept)?;
    Ok((losses.swap_remove(0), kl))
}

const OP_KL: &str = "balanced-kl";

struct Kl {
    divergence: Divergence,
    balance: KlBalance,
    values: Vec<f32>,
    q: Tensor,
    p: Tensor,
}

impl Backward for Kl {
    fn name(&self) -> &'static str {
        OP_KL
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None; 2]) };
        let grad = floats(OP_KL, grad)?;
        let scales = |scale: f64| -> Vec<f32> {
            let counts =
                self.values.iter().map(|value| f32::from(u8::from(*value >= self.balance.free as f32)));
            counts.zip(grad.iter()).map(|(counts, grad)| counts * grad * scale as f32).collect()
        };
        let (q, p) = (floats(OP_KL, &self.q)?, floats(OP_KL, &self.p)?);
        let (mut dq, mut dp) = (vec![0.0; q.len()], vec![0.0; p.len()]);
        let scales = (scales(self.balance.posterior_scale), scales(self.balance.prior_scale));
        self.divergence.backward(&q, &p, (&scales.0, &scales.1), &mut dq, &mut dp);
        let tensor = |values: Vec<f32>| Tensor::from_vec(values, self.q.shape(), self.q.device()).map(Some);
        Ok(vec![tensor(dq)?, tensor(dp)?])
    }
}
