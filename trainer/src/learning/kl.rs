use candle_core::{D, Result, Tensor};

use crate::model::latent::Latent;
use crate::ops;

/// Both halves of a branch's KL, each [B, T], summed over the categoricals and clipped from below.
#[derive(Debug, Clone)]
pub struct BranchKl {
    /// KL before it is clipped, without gradient.
    pub kl: Tensor,
    /// `max(free, KL[sg(q) || p])`, which trains the prior.
    pub dynamics: Tensor,
    /// `max(free, KL[q || sg(p)])`, which trains the posterior.
    pub representation: Tensor,
}

/// The balanced KL between a branch's posterior q and prior p (eq. 3), from their logits [B, T, n, m].
///
/// # Errors
/// Those of candle.
pub fn balanced_kl(posterior: &Latent, prior: &Latent, unimix: f64, free_nats: f64) -> Result<BranchKl> {
    let q = ops::probs(&posterior.logits, unimix)?;
    let p = ops::probs(&prior.logits, unimix)?;
    let (log_q, log_p) = (q.log()?, p.log()?);
    let kl =
        |q: &Tensor, log_q: &Tensor, log_p: &Tensor| (q * (log_q - log_p)?)?.sum(D::Minus1)?.sum(D::Minus1);
    let dynamics = kl(&q.detach(), &log_q.detach(), &log_p)?; // [B, T]
    let representation = kl(&q, &log_q, &log_p.detach())?;
    Ok(BranchKl {
        kl: dynamics.detach(),
        dynamics: dynamics.maximum(free_nats)?,
        representation: representation.maximum(free_nats)?,
    })
}
