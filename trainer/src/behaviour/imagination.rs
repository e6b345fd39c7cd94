use candle_core::{Result, Tensor};

use super::{Horizon, lambda_return, step_weights};
use crate::learning::parts::part;
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};

/// What the policy does in the model, from N starts over L states.
#[derive(Debug, Clone)]
pub struct Imagination {
    /// States s_t, the start first: [L, N, state width].
    pub features: Tensor,
    /// The actions between them: [L-1, N, action].
    pub actions: Tensor,
    /// Entropy of the distributions they were drawn from: [L-1, N, 1].
    pub entropy: Tensor,
    /// Predicted reward of each state: [L, N, 1].
    pub reward: Tensor,
    /// The critic's value of each state: [L, N, 1].
    pub value: Tensor,
    /// gamma times the predicted continuation: [L, N, 1].
    pub discount: Tensor,
    /// How much of a state is still reached: [L, N, 1], without gradient.
    pub weights: Tensor,
    /// Returns of the first L - 1 states: [L-1, N, 1] (eq. 10).
    pub returns: Tensor,
}

/// Imagines from every row of `start` [N, ...] with the actor choosing. Gradients flow from states and actions back
/// through the dynamics, but not into the actor's input.
///
/// # Errors
/// Those of candle; `horizon.length` must be at least 2.
pub fn imagine(
    agent: &Agent,
    start: &State,
    horizon: &Horizon,
    sampler: &mut Sampler,
) -> Result<Imagination> {
    let rollout = part("imagine", || rollout(agent, start, horizon, sampler))?;
    part("judge", || judge(agent, horizon, rollout))
}

/// States, actions and entropies of an imagination: see [`Imagination`].
struct Rollout {
    features: Tensor,
    actions: Tensor,
    entropy: Tensor,
}

fn rollout(agent: &Agent, start: &State, horizon: &Horizon, sampler: &mut Sampler) -> Result<Rollout> {
    let mut state = start.clone();
    let mut features = vec![state.features()?];
    let mut actions = Vec::with_capacity(horizon.length);
    let mut entropy = Vec::with_capacity(horizon.length);
    for step in 1..horizon.length {
        let policy = agent.actor.forward(&features[step - 1].detach())?;
        let action = policy.sample(sampler)?;
        state = agent.world.imagine_step(&state, &action, sampler)?;
        features.push(state.features()?);
        actions.push(action);
        entropy.push(policy.entropy()?.unsqueeze(1)?);
    }
    Ok(Rollout {
        features: Tensor::stack(&features, 0)?,
        actions: Tensor::stack(&actions, 0)?,
        entropy: Tensor::stack(&entropy, 0)?,
    })
}

/// Rewards, values and returns of the states.
fn judge(agent: &Agent, horizon: &Horizon, rollout: Rollout) -> Result<Imagination> {
    let Rollout { features, actions, entropy } = rollout;
    let reward = agent.heads.reward.mean(&agent.heads.reward.logits(&features)?)?;
    let value = agent.critic.mean(&agent.critic.logits(&features)?)?;
    let discount = (agent.heads.continue_probability(&features)? * horizon.discount)?;
    let weights = step_weights(&discount)?;
    let returns = lambda_return(&reward, &value, &discount, horizon.lambda)?;
    Ok(Imagination { features, actions, entropy, reward, value, discount, weights, returns })
}
