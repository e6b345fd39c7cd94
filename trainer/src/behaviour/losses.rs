use candle_core::{Result, Tensor};

use super::Imagination;
use crate::model::heads::TwoHotHead;

/// The actor's loss (eq. 11): `-mean(w_t ((R_t - v(s_t)) / scale + eta H_t))` over the first L-1 states. The gradient passes
/// through the returns and through the values, back through the dynamics to the actions.
pub fn actor_loss(imagined: &Imagination, scale: f64, entropy_scale: f64) -> Result<Tensor> {
    let steps = imagined.returns.dim(0)?;
    let advantage = ((&imagined.returns - imagined.value.narrow(0, 0, steps)?)? / scale)?; // [L-1, N, 1]
    let objective = (advantage + (&imagined.entropy * entropy_scale)?)?;
    (imagined.weights.narrow(0, 0, steps)? * objective)?.mean_all()?.neg()
}

/// The critic's loss (eq. 12): cross-entropy of its prediction with the returns, plus the same with what its slow copy predicts,
/// over the first L-1 states.
pub fn critic_loss(critic: &TwoHotHead, slow: &TwoHotHead, imagined: &Imagination) -> Result<Tensor> {
    let steps = imagined.returns.dim(0)?;
    let features = imagined.features.narrow(0, 0, steps)?.detach();
    let slow_value = slow.mean(&slow.logits(&features)?)?.squeeze(2)?;
    let logits = critic.logits(&features)?; // [L-1, N, bins]
    let returns = critic.logits_loss(&logits, &imagined.returns.squeeze(2)?)?; // [L-1, N]
    let loss = (returns + critic.logits_loss(&logits, &slow_value)?)?;
    (imagined.weights.narrow(0, 0, steps)?.squeeze(2)? * loss)?.mean_all()
}
