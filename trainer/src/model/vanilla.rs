//! The baseline: DreamerV3's world model, one branch, with a mask predictor so that it learns from the same masks.

use candle_core::{Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::batch::{Decoded, Observed, at_step, normalised_action, sequence};
use super::branch::Branch;
use super::decoder::{Decoder, decoder_channels};
use super::encoder::{ConvStack, flatten_channels_first, image_to_float};
use super::latent::{FirstSteps, Latent, Sampler, State};
use super::measured::Measured;
use super::parameters::{Built, Scope};

/// Encoder, one branch, decoder.
#[derive(Debug, Clone)]
pub struct Vanilla {
    encoder: ConvStack,
    /// The recurrent part.
    pub branch: Branch,
    /// Its picture.
    pub decoder: Decoder,
    /// The robot's measured state, where the model looks at it.
    pub measured: Option<Measured>,
}

impl Vanilla {
    /// Parts `encoder.*`, `dynamics.*`, `decoder.*`.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let (c, input) = (settings.cnn_depth, settings.stoch_width() + settings.action);
        // The decoder's, from the other end.
        let channels: Vec<_> = std::iter::once(settings.image_channels())
            .chain(decoder_channels(settings).into_iter().rev())
            .collect();
        Ok(Self {
            encoder: ConvStack::new(&scope.at("encoder"), &channels)?,
            branch: Branch::new(
                &scope.at("dynamics"),
                settings,
                input,
                16 * 8 * c + Measured::width(settings),
            )?,
            decoder: Decoder::new(&scope.at("decoder"), settings)?,
            measured: Measured::new(scope, settings)?,
        })
    }

    /// The embedding [N, 16*8c] of u8 images [N, S, S, 3 C], with what the robot measured [N, state] [N, 16*8c + hidden].
    pub fn encode(&self, images: &Tensor, state: Option<&Tensor>) -> Result<Vec<Tensor>> {
        Ok(vec![self.embed(&self.features(images)?, state)?])
    }

    /// Features of u8 images [N, S, S, 3 C]: [N, 4, 4, 8c].
    pub fn features(&self, images: &Tensor) -> Result<Tensor> {
        self.encoder.forward(&image_to_float(images)?)
    }

    /// The embedding of features [N, 4, 4, 8c] and of what the robot measured [N, state].
    pub fn embed(&self, features: &Tensor, state: Option<&Tensor>) -> Result<Tensor> {
        let embed = flatten_channels_first(features)?;
        match &self.measured {
            Some(measured) => measured.join(&embed, state),
            None => Ok(embed),
        }
    }

    /// The learned state an episode starts from.
    pub fn initial(&self, batch: usize) -> Result<State> {
        Ok(State { branches: vec![self.branch.initial(batch)?] })
    }

    /// h_t [B, d] from z_{t-1}, h_{t-1} and the action a_{t-1} [B, action].
    pub fn recur(&self, previous: &Latent, action: &Tensor) -> Result<Tensor> {
        let x = Tensor::cat(&[&previous.z.flatten_from(1)?, &normalised_action(action)?], 1)?;
        self.branch.recur(&x, &previous.h)
    }

    /// Filters a batch of sequences: `embeds` [B, T, E], `actions` [B, T, action], each the one that led to its image.
    pub fn observe(
        &self,
        embeds: &[Tensor],
        actions: &Tensor,
        first: &FirstSteps,
        sampler: &mut Sampler,
    ) -> Result<Observed> {
        let share = sequence(&self.branch.embed_share(&embeds[0])?)?; // [T, B, hidden]
        let actions = sequence(actions)?; // [T, B, action]
        let initial = self.initial(first.batch())?;
        let mut previous = initial.clone();
        let mut posteriors = Vec::with_capacity(first.length());
        for t in 0..first.length() {
            let carry = first.carry(t, actions.device())?;
            previous = carry.select_state(&initial, &previous)?;
            let action = at_step(&actions, t)?;
            let action = carry.select(&action.zeros_like()?, &action)?;
            let h = self.recur(&previous.branches[0], &action)?;
            let logits = self.branch.posterior_logits(&h, &at_step(&share, t)?)?;
            previous = State { branches: vec![self.branch.draw(logits, &h, sampler)?] };
            posteriors.push(previous.clone());
        }
        let posteriors = State::stack(&posteriors, 1)?; // [B, T, ...]
        let h = &posteriors.branches[0].h;
        let prior = self.branch.draw(self.branch.prior_logits(h)?, h, sampler)?;
        Ok(Observed { priors: State { branches: vec![prior] }, posteriors, interaction: None })
    }

    /// One imagined step: the state after `action` [B, action], drawn from the prior.
    pub fn imagine_step(&self, state: &State, action: &Tensor, sampler: &mut Sampler) -> Result<State> {
        let h = self.recur(&state.branches[0], action)?;
        Ok(State { branches: vec![self.branch.draw(self.branch.prior_logits(&h)?, &h, sampler)?] })
    }

    /// The image, and the mask that is predicted beside it.
    pub fn decode(&self, state: &State) -> Result<Decoded> {
        let picture = self.decoder.forward(&state.branches[0].features()?)?;
        Ok(Decoded { image: picture.image.clone(), pictures: vec![picture] })
    }
}
