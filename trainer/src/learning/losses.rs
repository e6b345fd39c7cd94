use candle_core::{D, Result, Tensor};
use serde::Serialize;

use super::parts::part;
use super::{Batch, BranchKl, WorldSettings, balanced_kl};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};
use crate::model::world::Observed;
use crate::ops;

/// The terms of the world model's loss, each a scalar before its factor, and what they came from.
#[derive(Debug, Clone)]
pub struct WorldLosses {
    /// Squared error of the picture, summed over pixels.
    pub image: Tensor,
    /// The same of the robot's mask; none when masks are not used.
    pub robot_mask: Option<Tensor>,
    /// Squared error of the robot's measured state in symlog space, summed over its numbers; none where the model does not look at it.
    pub state: Option<Tensor>,
    /// Cross-entropy of the reward.
    pub reward: Tensor,
    /// Cross-entropy of the continuation.
    pub continues: Tensor,
    /// Each branch's KL, the robot's first.
    pub branches: Vec<BranchKl>,
    /// Distance of the actor from demonstrated actions, where it has a part in the loss.
    pub cloning: Option<Tensor>,
    /// The sum with factors, which is differentiated.
    pub total: Tensor,
    /// The filtered batch.
    pub observed: Observed,
}

/// The losses of a batch as plain numbers, for metrics.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct LossValues {
    /// See [`WorldLosses`].
    pub total: f64,
    /// See [`WorldLosses`].
    pub image: f64,
    /// See [`WorldLosses`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot_mask: Option<f64>,
    /// See [`WorldLosses`].
    #[serde(rename = "state_loss", skip_serializing_if = "Option::is_none")]
    pub state: Option<f64>,
    /// See [`WorldLosses`].
    pub reward: f64,
    /// See [`WorldLosses`].
    #[serde(rename = "continue")]
    pub continues: f64,
    /// See [`WorldLosses`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cloning: Option<f64>,
    /// KL of the robot's branch (vanilla: of the only one), before it is clipped.
    pub robot_kl: f64,
    /// KL of the environment's branch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub environment_kl: Option<f64>,
}

/// The world model's losses of a batch (eq. 2, 3, 9).
pub fn world_losses(
    agent: &Agent,
    batch: &Batch,
    settings: &WorldSettings,
    sampler: &mut Sampler,
) -> Result<WorldLosses> {
    let seen = batch.seen.as_ref().unwrap_or(&batch.image);
    let embeds = part("encode", || agent.world.encode(seen, batch.state.as_ref()))?;
    let observed = part("observe", || agent.world.observe(&embeds, &batch.action, &batch.first, sampler))?;
    let reconstruction =
        part("decode", || reconstruction(agent, batch, settings.decode_every, &observed.posteriors))?;
    part("other losses", || other_losses(agent, batch, settings, observed, reconstruction))
}

/// Squared errors of the pictures and the robot's masks at every `every`-th step, which one first depends on the batch's number.
fn reconstruction(
    agent: &Agent,
    batch: &Batch,
    every: usize,
    posteriors: &State,
) -> Result<(Tensor, Option<Tensor>)> {
    let (every, length) = (every as u64, batch.first.length() as u64);
    if every == 1 {
        return agent.world.picture_loss(posteriors, &batch.image, batch.robot_mask.as_ref());
    }
    let steps: Vec<u32> =
        (0..length).filter(|t| (t + batch.number).is_multiple_of(every)).map(|t| t as u32).collect();
    let count = steps.len();
    let steps = Tensor::from_vec(steps, count, batch.image.device())?;
    let chosen = |x: &Tensor| x.contiguous()?.index_select(&steps, 1);
    let masks = batch.robot_mask.as_ref().map(chosen).transpose()?;
    agent.world.picture_loss(&posteriors.map(chosen)?, &chosen(&batch.image)?, masks.as_ref())
}

/// Heads, divergences and the sum, from the squared errors of the pictures and the robot's masks, [B*T] each.
fn other_losses(
    agent: &Agent,
    batch: &Batch,
    settings: &WorldSettings,
    observed: Observed,
    reconstruction: (Tensor, Option<Tensor>),
) -> Result<WorldLosses> {
    let image = reconstruction.0.mean_all()?;
    let robot_mask = reconstruction.1.map(|loss| loss.mean_all()).transpose()?;
    let state = agent.world.state_loss(&observed.posteriors, batch.state.as_ref())?;
    let state = state.map(|loss| loss.mean_all()).transpose()?;
    let features = observed.posteriors.features()?; // [B, T, state width]
    let reward = agent.heads.reward.loss(&features, &batch.reward)?.mean_all()?;
    let continues = continue_loss(&agent.heads.continue_logit(&features)?, &batch.terminal)?;
    let branches = observed
        .posteriors
        .branches
        .iter()
        .zip(&observed.priors.branches)
        .map(|(q, p)| balanced_kl(q, p, agent.settings.unimix, settings))
        .collect::<Result<Vec<_>>>()?;

    let mut total = ((&image * settings.image_scale)? + (&reward * settings.reward_scale)?)?;
    total = (total + (&continues * settings.continue_scale)?)?;
    if let Some(mask) = &robot_mask {
        total = (total + (mask * settings.mask_scale)?)?;
    }
    if let Some(state) = &state {
        total = (total + (state * settings.state_scale)?)?;
    }
    for branch in &branches {
        total = (total + branch.loss.mean_all()?)?;
    }
    Ok(WorldLosses { image, robot_mask, state, reward, continues, branches, cloning: None, total, observed })
}

/// Binary cross-entropy of the logits [B, T, 1] against going on, where not `terminal` [B, T]: a scalar. As a softmax over the
/// logits 0 and l it is stable for every l.
fn continue_loss(logit: &Tensor, terminal: &Tensor) -> Result<Tensor> {
    let logits = Tensor::cat(&[&logit.zeros_like()?, logit], 2)?; // [B, T, 2]: ends, goes on
    let target = Tensor::stack(&[terminal, &terminal.affine(-1.0, 1.0)?], 2)?;
    (target * ops::log_softmax(&logits)?)?.sum(D::Minus1)?.mean_all()?.neg()
}

impl WorldLosses {
    /// The same without gradient, which lets go of the graph.
    #[must_use]
    pub fn detached(&self) -> Self {
        Self {
            image: self.image.detach(),
            robot_mask: self.robot_mask.as_ref().map(Tensor::detach),
            state: self.state.as_ref().map(Tensor::detach),
            reward: self.reward.detach(),
            continues: self.continues.detach(),
            branches: self.branches.iter().map(BranchKl::detached).collect(),
            cloning: self.cloning.as_ref().map(Tensor::detach),
            total: self.total.detach(),
            observed: self.observed.detached(),
        }
    }

    /// The losses of a batch from those of shares of its rows, each with its share of the rows.
    pub fn merged(shares: &[(f64, Self)]) -> Result<Self> {
        if let [(_, all)] = shares {
            return Ok(all.clone());
        }
        let sum = |scalar: fn(&Self) -> Option<&Tensor>| -> Result<Option<Tensor>> {
            let terms = shares.iter().filter_map(|(weight, losses)| scalar(losses).map(|x| x * *weight));
            terms.reduce(|a, b| a? + b?).transpose()
        };
        let all =
            |scalar| sum(scalar)?.ok_or_else(|| candle_core::Error::Msg("losses of no rows".to_owned()));
        let observed: Vec<_> = shares.iter().map(|(_, losses)| &losses.observed).collect();
        let branch = |index: usize| BranchKl::cat(shares.iter().map(|(_, losses)| &losses.branches[index]));
        Ok(Self {
            image: all(|losses| Some(&losses.image))?,
            robot_mask: sum(|losses| losses.robot_mask.as_ref())?,
            state: sum(|losses| losses.state.as_ref())?,
            reward: all(|losses| Some(&losses.reward))?,
            continues: all(|losses| Some(&losses.continues))?,
            branches: (0..shares.first().map_or(0, |(_, losses)| losses.branches.len()))
                .map(branch)
                .collect::<Result<_>>()?,
            cloning: sum(|losses| losses.cloning.as_ref())?,
            total: all(|losses| Some(&losses.total))?,
            observed: Observed::cat(&observed)?,
        })
    }

    /// The plain numbers.
    pub fn values(&self) -> Result<LossValues> {
        let scalar = |x: &Tensor| Ok::<_, candle_core::Error>(f64::from(x.to_scalar::<f32>()?));
        let kl =
            |index: usize| self.branches.get(index).map(|branch| scalar(&branch.kl.mean_all()?)).transpose();
        Ok(LossValues {
            total: scalar(&self.total)?,
            image: scalar(&self.image)?,
            robot_mask: self.robot_mask.as_ref().map(scalar).transpose()?,
            state: self.state.as_ref().map(scalar).transpose()?,
            reward: scalar(&self.reward)?,
            continues: scalar(&self.continues)?,
            cloning: self.cloning.as_ref().map(scalar).transpose()?,
            robot_kl: kl(0)?.unwrap_or_default(),
            environment_kl: kl(1)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn the_continuation_loss_is_finite_and_right_for_every_logit() {
        let device = Device::Cpu;
        let values = [-200f32, -1.0, 0.0, 1.0, 200.0];
        for (ends, sign) in [(0f32, -1.0), (1.0, 1.0)] {
            for value in values {
                let logit = Var::from_vec(vec![value], (1, 1, 1), &device).unwrap();
                let loss = continue_loss(&logit, &Tensor::new(&[[ends]], &device).unwrap()).unwrap();
                let grads = loss.backward().unwrap();
                let slope = grads.get(&logit).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()[0];
                let x = sign * f64::from(value);
                let expected = if x > 50.0 { x } else { x.exp().ln_1p() };
                assert!((f64::from(loss.to_scalar::<f32>().unwrap()) - expected).abs() < 1e-6, "{value}");
                assert!((f64::from(slope) - sign / (1.0 + (-x).exp())).abs() < 1e-6, "{value} {slope}");
            }
        }
    }
}
