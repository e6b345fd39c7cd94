use candle_core::{D, DType, Result, Tensor};

use super::{log_softmax, softmax};

/// How a divergence becomes a loss (eq. 3): below `free` nats it costs a constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KlBalance {
    /// Nats that are free.
    pub free: f64,
    /// Weight of the half that trains the prior.
    pub prior_scale: f64,
    /// Weight of the half that trains the posterior.
    pub posterior_scale: f64,
}

/// Class probabilities with a share of the uniform distribution mixed in: `(1 - u) softmax(logits) + u / m`.
pub fn probs(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    let classes = logits.dim(D::Minus1)? as f64;
    softmax(logits)?.affine(1.0 - unimix, unimix / classes)
}

/// Logarithm of [`probs`].
pub fn log_probs(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    if unimix == 0.0 { log_softmax(logits) } else { probs(logits, unimix)?.log() }
}

/// One-hot of the largest entry of the last dimension (the first of equals), without gradient.
pub fn one_hot_of_best(scores: &Tensor) -> Result<Tensor> {
    let scores = scores.detach();
    let best = scores.argmax_keepdim(D::Minus1)?; // [..., 1] u32
    let classes = Tensor::arange(0u32, scores.dim(D::Minus1)? as u32, scores.device())?;
    best.broadcast_as(scores.shape())?.eq(&classes.broadcast_as(scores.shape())?)?.to_dtype(DType::F32)
}

/// A one-hot sample whose gradient passes through the probabilities: `sample + p - sg(p)`.
///
/// `gumbel` is added to the log-probabilities before the argmax, which draws from the distribution; without it the
/// sample is the most probable class.
pub fn straight_through_sample(logits: &Tensor, unimix: f64, gumbel: Option<&Tensor>) -> Result<Tensor> {
    let p = probs(logits, unimix)?;
    let sample = match gumbel {
        Some(gumbel) => one_hot_of_best(&(p.detach().log()? + gumbel)?)?,
        None => one_hot_of_best(&p)?,
    };
    sample + (&p - p.detach())?
}

/// The most probable class, with a gradient through the log-probabilities: `mode + log p - sg(log p)`.
pub fn straight_through_mode(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    let log_p = log_probs(logits, unimix)?;
    one_hot_of_best(&log_p)? + (&log_p - log_p.detach())?
}

/// See [`crate::ops::entropy`].
pub fn entropy(logits: &Tensor, unimix: f64) -> Result<Tensor> {
    (probs(logits, unimix)? * log_probs(logits, unimix)?)?.sum(D::Minus1)?.neg()
}

/// See [`crate::ops::balanced_kl`].
pub fn balanced_kl(q: &Tensor, p: &Tensor, unimix: f64, balance: KlBalance) -> Result<(Tensor, Tensor)> {
    let kl = |q: &Tensor, p: &Tensor| {
        let ratio = (log_probs(q, unimix)? - log_probs(p, unimix)?)?;
        (probs(q, unimix)? * ratio)?.sum(D::Minus1)?.sum(D::Minus1)
    };
    // Below the free nats the constant must win without a gradient; candle's maximum would split it between equals.
    let clipped = |kl: Tensor| {
        let counts = kl.ge(balance.free)?.to_dtype(DType::F32)?;
        (&kl * &counts)? + counts.affine(-balance.free, balance.free)?
    };
    let prior = kl(&q.detach(), p)?;
    let value = prior.detach();
    let posterior = kl(q, &p.detach())?;
    let loss = ((clipped(prior)? * balance.prior_scale)? + (clipped(posterior)? * balance.posterior_scale)?)?;
    Ok((loss, value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn a_sample_is_one_hot_and_its_gradient_is_that_of_the_probabilities() {
        let device = Device::Cpu;
        let logits = Var::new(&[[0.5f32, 2.0, -1.0]], &device).unwrap();
        let weights = Tensor::new(&[[1f32, 3.0, -2.0]], &device).unwrap();
        let grad_of = |y: Tensor| {
            let grads = (y * &weights).unwrap().sum_all().unwrap().backward().unwrap();
            grads.get(&logits).unwrap().to_vec2::<f32>().unwrap()
        };
        let gumbel = Tensor::new(&[[0f32, 0.0, 9.0]], &device).unwrap();
        let sample = straight_through_sample(&logits, 0.01, Some(&gumbel)).unwrap();
        assert_eq!(sample.to_vec2::<f32>().unwrap(), [[0.0, 0.0, 1.0]]);
        assert_eq!(grad_of(sample), grad_of(probs(&logits, 0.01).unwrap()));
        let mode = straight_through_mode(&logits, 0.01).unwrap();
        assert_eq!(mode.to_vec2::<f32>().unwrap(), [[0.0, 1.0, 0.0]]);
        assert_eq!(grad_of(mode), grad_of(log_probs(&logits, 0.01).unwrap()));
    }

    #[test]
    fn the_first_of_equal_classes_wins() {
        let scores = Tensor::new(&[[1f32, 2.0, 2.0]], &Device::Cpu).unwrap();
        assert_eq!(one_hot_of_best(&scores).unwrap().to_vec2::<f32>().unwrap(), [[0.0, 1.0, 0.0]]);
    }
}
