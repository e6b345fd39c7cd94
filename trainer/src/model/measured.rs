//! What the robot measures of itself (proprioception): into its posterior, and out of its latent state again. The
//! environment learns of it only through the interaction, by h and the prior sample of the robot, from the next step on.

use candle_core::{D, Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::layers::{Dense, Mlp};
use super::parameters::{Built, Scope};
use crate::ops;

/// Encoder and decoder of the measured state, both in symlog space, as DreamerV3 has them for vectors: joint angles and velocities
/// differ in size by orders of magnitude.
#[derive(Debug, Clone)]
pub struct Measured {
    encoder: [Dense; 2],
    decoder: Mlp,
    numbers: usize,
}

impl Measured {
    /// `encoder.state.0.*`, `encoder.state.1.*`, `decoder.state.*`; none in a model that looks at no state.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Option<Self>> {
        let (numbers, hidden) = (settings.state, settings.hidden);
        if numbers == 0 {
            return Ok(None);
        }
        let encoder = scope.at("encoder").at("state");
        let decoder = scope.at("decoder").at("state");
        Ok(Some(Self {
            encoder: [
                Dense::new(&encoder.at(0), numbers + 1, hidden)?,
                Dense::new(&encoder.at(1), hidden, hidden)?,
            ],
            decoder: Mlp::new(&decoder, settings.branch_width(), hidden, numbers, 1.0)?,
            numbers,
        }))
    }

    /// Width of what it adds to the robot's embedding.
    #[must_use]
    pub fn width(settings: &ModelSettings) -> usize {
        if settings.state > 0 { settings.hidden } else { 0 }
    }

    /// A robot's embedding `[image's, state's]` [N, E + hidden] of its image's [N, E] and the state as measured [N, numbers].
    pub fn join(&self, embed: &Tensor, state: Option<&Tensor>) -> Result<Tensor> {
        let Some(state) = state else {
            candle_core::bail!(
                "the model looks at a measured state of {} numbers, and none was given",
                self.numbers
            )
        };
        if state.dim(D::Minus1)? != self.numbers {
            let (found, needed) = (state.dims(), self.numbers);
            candle_core::bail!(
                "the model looks at a measured state of {needed} numbers, this one is {found:?}"
            )
        }
        let symlog = ops::symlog(state)?;
        // The norm behind the first product drops the length of what it is given: beside a constant, the length is part of the direction.
        let one = symlog.narrow(D::Minus1, 0, 1)?.ones_like()?;
        let x = self.encoder[0].forward(&Tensor::cat(&[&symlog, &one], D::Minus1)?)?; // [N, hidden]
        Tensor::cat(&[embed, &self.encoder[1].forward(&x)?], D::Minus1)
    }

    /// Squared error of what the robot's latent state s^R [..., n*m + d] alone says of the state [..., numbers], both in symlog space,
    /// summed over the numbers: [...].
    pub fn loss(&self, latent: &Tensor, state: &Tensor) -> Result<Tensor> {
        (self.decoder.forward(latent)? - ops::symlog(state)?)?.sqr()?.sum(D::Minus1)
    }
}
