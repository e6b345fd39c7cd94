use std::f64::consts::PI;

use candle_core::{D, Result, Tensor};
use serde::{Deserialize, Serialize};

use crate::model::heads::Actor;

/// What the distance between the actor and a demonstrated action is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CloningLoss {
    /// Squared error of the mean, summed over the components; the spread is left alone.
    #[default]
    SquaredError,
    /// Negative log-likelihood under the actor's distribution, in nats.
    Likelihood,
}

/// The mean distance of the actor from `actions` [N, action] in the states of `features` [N, state width]: a scalar.
pub fn cloning_loss(actor: &Actor, features: &Tensor, actions: &Tensor, loss: CloningLoss) -> Result<Tensor> {
    let policy = actor.forward(features)?;
    let error = (&policy.mean - actions)?;
    let distance = match loss {
        CloningLoss::SquaredError => error.sqr()?,
        CloningLoss::Likelihood => {
            let squares = (error / &policy.std)?.sqr()?.affine(0.5, 0.5 * (2.0 * PI).ln())?;
            (squares + policy.std.log()?)?
        }
    };
    distance.sum(D::Minus1)?.mean_all()
}
