use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use ndarray::Axis;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, ModelSettings};

use super::batch::examples;
use super::{Batch, Shift};
use crate::model::agent::Agent;
use crate::model::latent::{FirstSteps, Latent, Sampler, State};

/// Demonstrations that are filtered at a time.
const EPISODES_AT_ONCE: usize = 10;

/// How often and how demonstrations are filtered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Views {
    /// Times in all; the first with the most probable classes.
    pub draws: u64,
    /// Pixels by which pictures are shifted at most from the second time on.
    pub shift: usize,
    /// Draws of classes and shifts depend on this.
    pub seed: u64,
}

/// States of demonstrations and the actions taken in them.
#[derive(Debug, Clone)]
pub struct Examples {
    /// [N, state width].
    features: Tensor,
    /// [N, action].
    actions: Tensor,
}

impl Examples {
    /// Filters every episode several times: first as it is with the most probable classes, then shifted and with draws. Carries no gradient
    /// if the agent's parameters do not.
    ///
    /// # Errors
    /// Those of candle, also if no episode has two steps.
    pub fn filter(agent: &Agent, episodes: &[Arc<Episode>], views: &Views, device: &Device) -> Result<Self> {
        let (mut features, mut actions) = (Vec::new(), Vec::new());
        for (chunk, episodes) in episodes.chunks(EPISODES_AT_ONCE).enumerate() {
            let mut padded = Padded::new(agent, episodes, &|_| Shift::default(), device)?;
            for draw in 0..views.draws {
                let number = chunk as u64 * views.draws + draw;
                let mut sampler =
                    if draw == 0 { Sampler::Mode } else { Sampler::numbered(views.seed, number) };
                if draw > 0 && views.shift > 0 {
                    let shift = |row| Shift::drawn(views.shift, views.seed, number, row);
                    padded = Padded::new(agent, episodes, &shift, device)?;
                }
                let posteriors = agent
                    .world
                    .observe(&padded.embeds, &padded.actions, &padded.first, &mut sampler)?
                    .posteriors;
                let states = posteriors.features()?.flatten(0, 1)?; // [B*T, state width]
                features.push(states.index_select(&padded.chosen, 0)?);
                actions.push(padded.taken.clone());
            }
        }
        Ok(Self { features: Tensor::cat(&features, 0)?, actions: Tensor::cat(&actions, 0)? })
    }

    /// Examples that are known already: features [N, state width], actions [N, action].
    #[must_use]
    pub fn new(features: Tensor, actions: Tensor) -> Self {
        Self { features, actions }
    }

    /// The places of a batch's examples among its B * T steps.
    #[must_use]
    pub fn places_in(batch: &Batch) -> Vec<u32> {
        let (first, pushed) = (batch.first.flags(), &batch.pushed);
        let length = first.len() / batch.first.batch().max(1);
        let examples = examples(first, pushed, length).enumerate();
        examples.filter_map(|(at, example)| example.then_some(at as u32)).collect()
    }

    /// The examples in a batch, from its posterior features [B, T, state width]: features [N, state width] and actions [N, action].
    ///
    /// # Errors
    /// Those of candle, also if there is none.
    pub fn of_batch(features: &Tensor, batch: &Batch) -> Result<(Tensor, Tensor)> {
        let (chosen, actions) = (Self::places_in(batch), &batch.action);
        let next: Vec<u32> = chosen.iter().map(|index| index + 1).collect();
        let pick = |x: &Tensor, indices: Vec<u32>| {
            let count = indices.len();
            x.flatten(0, 1)?.index_select(&Tensor::from_vec(indices, count, x.device())?, 0)
        };
        Ok((pick(features, chosen)?, pick(actions, next)?.clamp(-1f32, 1f32)?))
    }

    /// Features [N, state width] and actions [N, action] of all.
    #[must_use]
    pub fn all(&self) -> (&Tensor, &Tensor) {
        (&self.features, &self.actions)
    }

    /// N.
    pub fn count(&self) -> Result<usize> {
        self.features.dim(0)
    }

    /// Batch `number` of a seed: `rows` examples, each equally likely, as features and actions.
    pub fn draw(&self, rows: usize, seed: u64, number: u64) -> Result<(Tensor, Tensor)> {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(number);
        let count = self.count()? as u32;
        if count == 0 {
            return Err(candle_core::Error::Msg("no demonstration holds an action to learn from".into()));
        }
        let chosen: Vec<u32> = (0..rows).map(|_| generator.random_range(0..count)).collect();
        let chosen = Tensor::from_vec(chosen, rows, self.features.device())?;
        Ok((self.features.index_select(&chosen, 0)?, self.actions.index_select(&chosen, 0)?))
    }
}

/// Episodes side by side, shorter ones filled up with zeros.
struct Padded {
    /// [B, T, E] per branch.
    embeds: Vec<Tensor>,
    /// [B, T, action].
    actions: Tensor,
    first: FirstSteps,
    /// Which of the B * T steps are examples: [N].
    chosen: Tensor,
    /// The actions taken in them: [N, action].
    taken: Tensor,
}

impl Padded {
    fn new(
        agent: &Agent,
        episodes: &[Arc<Episode>],
        shift: &dyn Fn(usize) -> Shift,
        device: &Device,
    ) -> Result<Self> {
        let length = episodes.iter().map(|episode| episode.len()).max().unwrap_or(0);
        let width = agent.settings.action;
        let (mut embeds, mut actions, mut first) = (Vec::new(), Vec::new(), Vec::new());
        let (mut chosen, mut taken) = (Vec::new(), Vec::new());
        for (row, episode) in episodes.iter().enumerate() {
            let missing = length - episode.len();
            let mut images: Vec<u8> = episode.image.iter().copied().collect();
            let (steps, side) = (episode.len(), episode.side());
            shift(row).apply(&mut images, side, episode.image.len_of(Axis(3)));
            let images = Tensor::from_vec(images, (1, steps, side, side, ()), device)?;
            let state = episode.proprio.as_ref().filter(|_| agent.settings.state > 0);
            let state = state
                .map(|state| Tensor::from_iter(state.iter().copied(), device)?.reshape((1, steps, ())))
                .transpose()?;
            let own = agent.world.encode(&images, state.as_ref())?;
            embeds.push(own.iter().map(|x| x.pad_with_zeros(1, 0, missing)).collect::<Result<Vec<_>>>()?);
            actions.extend(episode.action.iter().copied());
            actions.extend(std::iter::repeat_n(0.0, missing * width));
            first.extend((0..length).map(|t| t == 0 || episode.is_first.get(t).is_some_and(|first| *first)));
            for (t, action) in actions_taken(episode) {
                chosen.push((row * length + t) as u32);
                taken.extend(action);
            }
        }
        let rows = episodes.len();
        let branches = embeds.first().map_or(0, Vec::len);
        let stack = |branch: usize| Tensor::cat(&embeds.iter().map(|x| &x[branch]).collect::<Vec<_>>(), 0);
        let count = chosen.len();
        Ok(Self {
            embeds: (0..branches).map(stack).collect::<Result<_>>()?,
            actions: Tensor::from_vec(actions, (rows, length, width), device)?,
            first: FirstSteps::new(first, length),
            chosen: Tensor::from_vec(chosen, count, device)?,
            taken: Tensor::from_vec(taken, (count, width), device)?,
        })
    }
}

/// The steps of an episode in which an action was taken that is an example, with the action, each in [-1, 1].
pub fn actions_taken(episode: &Episode) -> impl Iterator<Item = (usize, Vec<f32>)> {
    let taken = |t: usize| episode.action.row(t + 1).iter().map(|x| x.clamp(-1.0, 1.0)).collect();
    (0..episode.len().saturating_sub(1))
        .filter(|t| !episode.is_first[t + 1] && !episode.pushed[t + 1])
        .map(move |t| (t, taken(t)))
}

/// The state that `features` [N, state width] were made of. What is known of its logits is where z has its classes: imagination never
/// looks at those of its start.
pub fn state_of_features(features: &Tensor, model: &ModelSettings) -> Result<State> {
    let (n, m, d) = (model.categoricals, model.classes, model.deter);
    let branches = match model.kind {
        ModelKind::Rcwm => 2,
        ModelKind::Vanilla => 1,
    };
    let branch = |index: usize| {
        let from = index * model.branch_width();
        let z = features.narrow(1, from, n * m)?.contiguous()?.reshape(((), n, m))?;
        let h = features.narrow(1, from + n * m, d)?.contiguous()?;
        Ok(Latent { logits: z.clone(), z, h })
    };
    Ok(State { branches: (0..branches).map(branch).collect::<Result<_>>()? })
}
