use candle_core::{Result, Tensor};

use super::WorldSettings;
use crate::model::latent::Latent;
use crate::ops::{self, KlBalance};

/// A branch's KL, summed over the categoricals, [B, T].
#[derive(Debug, Clone)]
pub struct BranchKl {
    /// KL before it is clipped, without gradient.
    pub kl: Tensor,
    /// Both halves, each clipped from below, with their factors: `c_p max(free, KL[sg(q) || p])`, which trains the prior, and
    /// `c_q max(free, KL[q || sg(p)])`, which trains the posterior.
    pub loss: Tensor,
}

impl BranchKl {
    /// Without gradient.
    pub(super) fn detached(&self) -> Self {
        Self { kl: self.kl.detach(), loss: self.loss.detach() }
    }

    /// Rows after rows.
    pub(super) fn cat<'a>(shares: impl Iterator<Item = &'a Self>) -> Result<Self> {
        let (kl, loss): (Vec<_>, Vec<_>) = shares.map(|share| (&share.kl, &share.loss)).unzip();
        Ok(Self { kl: Tensor::cat(&kl, 0)?, loss: Tensor::cat(&loss, 0)? })
    }
}

/// The balanced KL between a branch's posterior q and prior p (eq. 3), from their logits [B, T, n, m].
pub fn balanced_kl(
    posterior: &Latent,
    prior: &Latent,
    unimix: f64,
    settings: &WorldSettings,
) -> Result<BranchKl> {
    let balance = KlBalance {
        free: settings.free_nats,
        prior_scale: settings.dynamics_scale,
        posterior_scale: settings.representation_scale,
    };
    let (loss, kl) = ops::balanced_kl(&posterior.logits, &prior.logits, unimix, balance)?;
    Ok(BranchKl { kl, loss })
}
