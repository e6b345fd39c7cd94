use candle_core::{Device, Result, Tensor};
use rcwm_models::wire::ActionValues;
use rcwm_models::{IMAGE_CHANNELS, IMAGE_SIDE};

use super::filter_step;
use crate::model::agent::Agent;
use crate::model::latent::{Latent, Sampler, State};

/// What one simulator shows.
#[derive(Debug, Clone, Copy)]
pub struct PolicyInput<'a> {
    /// Which one: its place among all of them.
    pub simulator: usize,
    /// Whether an episode begins.
    pub first: bool,
    /// u8 [64, 64, 3].
    pub image: &'a [u8],
    /// The action that led here.
    pub executed: ActionValues,
}

/// What one simulator is to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// Each in [-1, 1].
    pub action: ActionValues,
    /// Whether the policy gave a number that is not finite: zeros stand for its action then, and the state begins anew.
    pub refused: bool,
}

/// The policy with a latent state for every simulator.
#[derive(Debug)]
pub struct Policy {
    /// Carries no gradient, and sees every update of the parameters at once.
    agent: Agent,
    states: Vec<Option<State>>,
    device: Device,
}

impl Policy {
    /// A policy for `simulators` of them; the agent's parameters must be frozen.
    #[must_use]
    pub fn new(agent: Agent, simulators: usize, device: &Device) -> Self {
        Self { agent, states: vec![None; simulators], device: device.clone() }
    }

    /// Decides for all simulators that show something, in one batch.
    pub fn decide(&mut self, seen: &[PolicyInput<'_>], sampler: &mut Sampler) -> Result<Vec<Decision>> {
        if seen.is_empty() {
            return Ok(Vec::new());
        }
        let initial = self.agent.world.initial(1)?;
        let before: Vec<&State> = seen
            .iter()
            .map(|one| match &self.states[one.simulator] {
                Some(state) if !one.first => state,
                _ => &initial,
            })
            .collect();
        let images: Vec<u8> = seen.iter().flat_map(|one| one.image.iter().copied()).collect();
        let mut actions = Vec::with_capacity(seen.len() * seen[0].executed.len());
        for one in seen {
            let executed = if one.first { ActionValues::zeros(one.executed.len()) } else { one.executed };
            actions.extend_from_slice(&executed);
        }
        let shape = (seen.len(), IMAGE_SIDE, IMAGE_SIDE, IMAGE_CHANNELS);
        let images = Tensor::from_vec(images, shape, &self.device)?;
        let actions = Tensor::from_vec(actions, (seen.len(), seen[0].executed.len()), &self.device)?;
        let states = filter_step(&self.agent.world, &rows(&before)?, &images, &actions, sampler)?;
        let decided = self.agent.actor.forward(&states.features()?)?.sample(sampler)?.to_vec2::<f32>()?;
        let mut decisions = Vec::with_capacity(seen.len());
        for (row, (one, action)) in seen.iter().zip(decided).enumerate() {
            let refused = action.iter().any(|x| !x.is_finite());
            let state = if refused { None } else { Some(states.map(|x| x.narrow(0, row, 1))?) };
            self.states[one.simulator] = state;
            let action = action.into_iter().map(|x| if refused { 0.0 } else { x.clamp(-1.0, 1.0) }).collect();
            decisions.push(Decision { action, refused });
        }
        Ok(decisions)
    }
}

/// States of one row each as one of several rows.
fn rows(states: &[&State]) -> Result<State> {
    let branches = states.first().map_or(0, |state| state.branches.len());
    let cat = |branch: usize, field: fn(&Latent) -> &Tensor| {
        Tensor::cat(&states.iter().map(|state| field(&state.branches[branch])).collect::<Vec<_>>(), 0)
    };
    let branch = |index: usize| {
        Ok(Latent { z: cat(index, |l| &l.z)?, h: cat(index, |l| &l.h)?, logits: cat(index, |l| &l.logits)? })
    };
    Ok(State { branches: (0..branches).map(branch).collect::<Result<_>>()? })
}
