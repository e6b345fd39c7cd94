//! What every world model can do, whichever it is.

use candle_core::{Result, Tensor};
use rcwm_models::settings::{ModelKind, ModelSettings};

pub use super::batch::{Decoded, Observed, normalised_action};
use super::batch::{at_step, sequence};
use super::latent::{FirstSteps, Sampler, State};
use super::parameters::{Built, Scope};
use super::{rcwm::Rcwm, vanilla::Vanilla};
use crate::ops;

/// A world model.
#[derive(Debug, Clone)]
pub enum World {
    /// The paper's.
    Rcwm(Box<Rcwm>),
    /// The baseline.
    Vanilla(Box<Vanilla>),
}

impl World {
    /// The model that the settings name.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        Ok(match settings.kind {
            ModelKind::Rcwm => Self::Rcwm(Box::new(Rcwm::new(scope, settings)?)),
            ModelKind::Vanilla => Self::Vanilla(Box::new(Vanilla::new(scope, settings)?)),
        })
    }

    /// Embeddings of u8 images [B, T, S, S, 3 C] and, where the model looks at it, of the robot's measured state [B, T, state], one per
    /// branch: [B, T, E].
    pub fn encode(&self, images: &Tensor, state: Option<&Tensor>) -> Result<Vec<Tensor>> {
        let (batch, length) = (images.dim(0)?, images.dim(1)?);
        let images = images.flatten(0, 1)?; // [B*T, S, S, 3 C]
        let state = state.map(|state| state.flatten(0, 1)).transpose()?; // [B*T, state]
        let embeds = match self {
            Self::Rcwm(model) => model.encode(&images, state.as_ref())?,
            Self::Vanilla(model) => model.encode(&images, state.as_ref())?,
        };
        embeds.iter().map(|embed| embed.reshape((batch, length, ()))).collect()
    }

    /// The learned state an episode starts from, [B, ...].
    pub fn initial(&self, batch: usize) -> Result<State> {
        match self {
            Self::Rcwm(model) => model.initial(batch),
            Self::Vanilla(model) => model.initial(batch),
        }
    }

    /// Filters a batch of sequences: `embeds` [B, T, E] per branch, `actions` [B, T, action], each the one that led to its image.
    pub fn observe(
        &self,
        embeds: &[Tensor],
        actions: &Tensor,
        first: &FirstSteps,
        sampler: &mut Sampler,
    ) -> Result<Observed> {
        match self {
            Self::Rcwm(model) => model.observe(embeds, actions, first, sampler),
            Self::Vanilla(model) => model.observe(embeds, actions, first, sampler),
        }
    }

    /// One imagined step: the state after `action` [B, action], drawn from the priors.
    pub fn imagine_step(&self, state: &State, action: &Tensor, sampler: &mut Sampler) -> Result<State> {
        match self {
            Self::Rcwm(model) => model.imagine_step(state, action, sampler),
            Self::Vanilla(model) => model.imagine_step(state, action, sampler),
        }
    }

    /// Imagines with given actions [B, L, action] from a state [B, ...]: the L states after them, [B, L, ...].
    pub fn imagine(&self, start: &State, actions: &Tensor, sampler: &mut Sampler) -> Result<State> {
        let actions = sequence(actions)?; // [L, B, action]
        let mut states: Vec<State> = Vec::with_capacity(actions.dim(0)?);
        for t in 0..actions.dim(0)? {
            let state = states.last().unwrap_or(start);
            states.push(self.imagine_step(state, &at_step(&actions, t)?, sampler)?);
        }
        State::stack(&states, 1)
    }

    /// [`World::imagine`], with the interaction's attention maps [B, L, n, n+k]; none in the vanilla baseline, which has no
    /// interaction.
    pub fn imagine_attending(
        &self,
        start: &State,
        actions: &Tensor,
        sampler: &mut Sampler,
    ) -> Result<Option<(State, Tensor)>> {
        let Self::Rcwm(model) = self else { return Ok(None) };
        let actions = sequence(actions)?; // [L, B, action]
        let (mut states, mut maps): (Vec<State>, Vec<Tensor>) = (Vec::new(), Vec::new());
        for t in 0..actions.dim(0)? {
            let state = states.last().unwrap_or(start);
            let (state, attention) = model.attend_step(state, &at_step(&actions, t)?, sampler)?;
            states.push(state);
            maps.push(attention);
        }
        Ok(Some((State::stack(&states, 1)?, Tensor::stack(&maps, 1)?)))
    }

    /// Squared errors of a state's picture, [N], and of the robot's mask if the true one is given: [`ops::picture_loss`] of
    /// [`World::decode`], at a fraction of its cost. `images` are u8 [..., S, S, 3 C], `masks` [..., S, S, C] of 0 and 1. The
    /// cameras of a pixel count as pixels side by side, each with a mask of its own.
    pub fn picture_loss(
        &self,
        state: &State,
        images: &Tensor,
        masks: Option<&Tensor>,
    ) -> Result<(Tensor, Option<Tensor>)> {
        let decoders = match self {
            Self::Rcwm(model) => model.decoders.as_slice(),
            Self::Vanilla(model) => std::slice::from_ref(&model.decoder),
        };
        let pairs = decoders.iter().zip(&state.branches);
        let maps = pairs
            .map(|(decoder, latent)| Ok((decoder.first_map(&latent.features()?)?, decoder.layers())))
            .collect::<Result<Vec<_>>>()?;
        let stacks: Vec<_> = maps.iter().map(|(map, layers)| (map, layers.as_slice())).collect();
        let [.., side, _, channels] = *images.dims() else {
            candle_core::bail!("no images: {:?}", images.dims())
        };
        let columns = side * channels / 3;
        let images = images.reshape(((), side, columns, 3))?;
        let masks = masks.map(|masks| masks.reshape(((), side, columns))).transpose()?;
        ops::reconstruction_loss(&stacks, &images, masks.as_ref())
    }

    /// Error [B, T] of what the robot's latent state alone says of its measured state [B, T, state], in symlog space; none in a model that
    /// does not look at it.
    pub fn state_loss(&self, posteriors: &State, state: Option<&Tensor>) -> Result<Option<Tensor>> {
        let measured = match self {
            Self::Rcwm(model) => &model.measured,
            Self::Vanilla(model) => &model.measured,
        };
        // The robot's latent state is the first, and of the baseline the only one.
        let pair = measured.as_ref().zip(state);
        pair.map(|(measured, state)| measured.loss(&posteriors.branches[0].features()?, state)).transpose()
    }

    /// The pictures of a state [..., ...].
    pub fn decode(&self, state: &State) -> Result<Decoded> {
        match self {
            Self::Rcwm(model) => model.decode(state),
            Self::Vanilla(model) => model.decode(state),
        }
    }
}
