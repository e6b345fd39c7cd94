//! What is read from a latent state: reward, continuation, value and action.

use std::f64::consts::{E, PI};

use candle_core::{D, Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::latent::Sampler;
use super::layers::Mlp;
use super::parameters::{Built, Scope};
use crate::ops;

/// A value as a two-hot distribution over symlog bins: reward and critic.
#[derive(Debug, Clone)]
pub struct TwoHotHead {
    mlp: Mlp,
    /// In symlog space, [bins].
    bins: Tensor,
}

impl TwoHotHead {
    /// The last layer starts at 0, and so does every prediction.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let mlp = Mlp::new(scope, settings.state_width(), settings.units, settings.bins, 0.0)?;
        Ok(Self { mlp, bins: ops::bins_tensor(settings.bins, &scope.device())? })
    }

    /// Logits [..., bins] of `features` [..., state width].
    pub fn logits(&self, features: &Tensor) -> Result<Tensor> {
        self.mlp.forward(features)
    }

    /// Cross-entropy of the prediction from `features` [..., state width] with the two-hot distributions of `values` [...]: [...].
    pub fn loss(&self, features: &Tensor, values: &Tensor) -> Result<Tensor> {
        self.logits_loss(&self.logits(features)?, values)
    }

    /// [`TwoHotHead::loss`] of logits [..., bins].
    pub fn logits_loss(&self, logits: &Tensor, values: &Tensor) -> Result<Tensor> {
        ops::two_hot_loss(logits, &self.bins, &ops::symlog(&values.detach())?)
    }

    /// Mean of the distribution given by logits [..., bins]: [..., 1].
    pub fn mean(&self, logits: &Tensor) -> Result<Tensor> {
        ops::two_hot_mean(logits, &self.bins)
    }
}

/// Reward and continuation, which belong to the world model.
#[derive(Debug, Clone)]
pub struct Heads {
    /// Expected reward.
    pub reward: TwoHotHead,
    continues: Mlp,
}

impl Heads {
    /// `reward.*` and `continue.*`.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let reward = TwoHotHead::new(&scope.at("reward"), settings)?;
        let continues = Mlp::new(&scope.at("continue"), settings.state_width(), settings.units, 1, 1.0)?;
        Ok(Self { reward, continues })
    }

    /// Logit [..., 1] of the probability that the episode goes on.
    pub fn continue_logit(&self, features: &Tensor) -> Result<Tensor> {
        self.continues.forward(features)
    }

    /// The probability itself.
    pub fn continue_probability(&self, features: &Tensor) -> Result<Tensor> {
        ops::sigmoid(&self.continue_logit(features)?)
    }
}

/// The policy.
#[derive(Debug, Clone)]
pub struct Actor {
    mlp: Mlp,
}

/// Independent normal distributions, one per action component.
#[derive(Debug, Clone)]
pub struct ActionDistribution {
    /// [..., action], in (-1, 1).
    pub mean: Tensor,
    /// [..., action], in (0.1, 1).
    pub std: Tensor,
}

impl Actor {
    /// `0.*`, `1.*`, `out.*`.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let mlp = Mlp::new(scope, settings.state_width(), settings.units, 2 * settings.action, 1.0)?;
        Ok(Self { mlp })
    }

    /// The distribution of actions in a state: `mean = tanh(.)`, `std = 0.9 sigmoid(. + 2) + 0.1`.
    pub fn forward(&self, features: &Tensor) -> Result<ActionDistribution> {
        let out = self.mlp.forward(features)?; // [..., 2 * action]
        let action = out.dim(D::Minus1)? / 2;
        let mean = out.narrow(D::Minus1, 0, action)?.tanh()?;
        let std = ops::sigmoid(&(out.narrow(D::Minus1, action, action)? + 2.0)?)?.affine(0.9, 0.1)?;
        Ok(ActionDistribution { mean, std })
    }
}

impl ActionDistribution {
    /// A sample with a gradient, divided back into [-1, 1]; the mean for [`Sampler::Mode`].
    pub fn sample(&self, sampler: &mut Sampler) -> Result<Tensor> {
        match sampler.normal(self.mean.dims(), self.mean.device())? {
            None => Ok(self.mean.clone()),
            Some(noise) => super::world::normalised_action(&(&self.mean + (&self.std * noise)?)?),
        }
    }

    /// Differential entropy, summed over the components: [...].
    pub fn entropy(&self) -> Result<Tensor> {
        let constant = 0.5 * (2.0 * PI * E).ln();
        (self.std.log()? + constant)?.sum(D::Minus1)
    }
}
