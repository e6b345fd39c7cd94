use std::collections::BTreeMap;
use std::ops::Range;

use candle_core::Tensor;
use rcwm_models::settings::ModelSettings;
use serde::Serialize;

use super::{BehaviourSettings, Imagination, ReturnRange, actor_loss, critic_loss, imagine};
use crate::learning::parts::part;
use crate::learning::{Adam, Gradients, LearningError, Trained};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};
use crate::model::parameters::{Parameters, mix};
use crate::ops;

/// Actor, critic and its slow copy with what it takes to train them. The world model is only read: no gradient reaches it.
#[derive(Debug, Clone)]
pub struct BehaviourLearner {
    /// The actor trains; everything else is frozen (the critic too, unless the settings say otherwise).
    acting: Agent,
    /// The critic trains; everything else is frozen.
    judging: Agent,
    parameters: Parameters,
    settings: BehaviourSettings,
    actor_adam: Adam,
    critic_adam: Adam,
    return_range: ReturnRange,
}

/// Losses and gradients of one update, before it is made.
#[derive(Debug, Clone)]
pub struct BehaviourGradients {
    /// Gradients of the actor's loss in the actor.
    pub actor: Gradients,
    /// Gradients of the critic's loss in the critic.
    pub critic: Gradients,
    /// The plain numbers.
    pub values: BehaviourUpdate,
}

/// What one update of actor and critic was.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct BehaviourUpdate {
    /// The actor's loss.
    pub actor_loss: f64,
    /// The critic's loss.
    pub critic_loss: f64,
    /// Norm of the actor's gradients before clipping.
    pub actor_gradient_norm: f64,
    /// Norm of the critic's gradients before clipping.
    pub critic_gradient_norm: f64,
    /// Mean entropy of the actor, in nats.
    pub entropy: f64,
    /// Mean predicted reward.
    pub reward: f64,
    /// Mean lambda return.
    pub lambda_return: f64,
    /// Mean value.
    pub value: f64,
    /// What returns are divided by.
    pub return_scale: f64,
}

impl BehaviourUpdate {
    /// Adds a share's part of every mean over rows.
    fn add(&mut self, share: &Self) {
        self.actor_loss += share.actor_loss;
        self.critic_loss += share.critic_loss;
        self.entropy += share.entropy;
        self.reward += share.reward;
        self.lambda_return += share.lambda_return;
        self.value += share.value;
    }
}

type NamedTensors = BTreeMap<String, Tensor>;

impl BehaviourLearner {
    /// A learner on `parameters`, which it shares.
    ///
    /// # Errors
    /// If the parameters do not fit the model.
    pub fn new(
        parameters: &Parameters,
        model: &ModelSettings,
        settings: &BehaviourSettings,
    ) -> Result<Self, LearningError> {
        let agent = |trained: Trained| Agent::new(&parameters.trainable_where(trained.filter()), model);
        let acting = if settings.actor_loss_reaches_critic { Trained::Behaviour } else { Trained::Actor };
        Ok(Self {
            acting: agent(acting)?,
            judging: agent(Trained::Critic)?,
            parameters: parameters.clone(),
            settings: settings.clone(),
            actor_adam: Adam::new(settings.actor.clone()),
            critic_adam: Adam::new(settings.critic.clone()),
            return_range: ReturnRange::default(),
        })
    }

    /// One update from imaginations that start in every row of `start` [N, ...], which carries no gradient.
    ///
    /// # Errors
    /// See [`LearningError`]; actor and critic are then as they were.
    pub fn update(&mut self, start: &State, sampler: &mut Sampler) -> Result<BehaviourUpdate, LearningError> {
        part("slow critic", || self.mix_slow_critic())?;
        let imagined = self.imagine_shares(start, sampler)?;
        let gradients = self.gradients(imagined)?;
        part("behaviour Adam", || self.apply(&gradients))?;
        Ok(gradients.values)
    }

    /// Moves the slow critic towards the critic.
    pub fn mix_slow_critic(&self) -> candle_core::Result<()> {
        let share = self.settings.slow_critic_share;
        for (name, slow) in self.parameters.iter() {
            let Some(name) = name.strip_prefix("slow_") else { continue };
            let Some(critic) = self.parameters.get(name) else { continue };
            mix(slow, critic, share)?;
        }
        Ok(())
    }

    /// Imagines with the actor, keeping the graph.
    pub fn imagine(&self, start: &State, sampler: &mut Sampler) -> candle_core::Result<Imagination> {
        imagine(&self.acting, start, &self.settings.horizon, sampler)
    }

    /// The same by all threads, each with some of the starts: their imaginations, in the starts' order. Rows know nothing of each other, so
    /// no thread waits for another.
    pub fn imagine_shares(
        &self,
        start: &State,
        sampler: &mut Sampler,
    ) -> candle_core::Result<Vec<Imagination>> {
        let Some(first) = start.branches.first() else { return Ok(Vec::new()) };
        let rows = first.h.dim(0)?;
        let whole = &*sampler;
        let shares = ops::in_parallel(ops::shares_of(rows, first.h.device()), |share: Range<usize>| {
            let mut sampler = whole.share(share.clone(), rows);
            Ok((self.imagine(&start.rows(&share)?, &mut sampler)?, sampler))
        });
        let shares = shares.into_iter().collect::<candle_core::Result<Vec<_>>>()?;
        let (imagined, samplers): (Vec<_>, Vec<_>) = shares.into_iter().unzip();
        samplers.into_iter().for_each(|share| sampler.follow(share));
        Ok(imagined)
    }

    /// Takes the returns of all shares into the range, then gives losses and gradients of actor and critic.
    pub fn gradients(&mut self, imagined: Vec<Imagination>) -> Result<BehaviourGradients, LearningError> {
        let mut range = self.return_range;
        let returns: Vec<_> = imagined.iter().map(|share| &share.returns).collect();
        let returns = Tensor::cat(&returns, 1)?; // [L-1, N, 1]
        part("return range", || range.update(&returns, &self.settings))?;
        let rows = returns.dim(1)?;
        let shares = ops::in_parallel(imagined, |share| self.share_gradients(share, range, rows));
        let (mut actors, mut critics) = (Vec::new(), Vec::new());
        let mut values = BehaviourUpdate { return_scale: range.scale(), ..BehaviourUpdate::default() };
        for share in shares {
            let (actor, critic, share_values) = share?;
            actors.push(actor);
            critics.push(critic);
            values.add(&share_values);
        }
        self.return_range = range;
        let (actor, critic) = part("behaviour sum", || {
            Ok::<_, LearningError>((Gradients::sum(actors)?, Gradients::sum(critics)?))
        })?;
        values.actor_gradient_norm = actor.norm();
        values.critic_gradient_norm = critic.norm();
        Ok(BehaviourGradients { actor, critic, values })
    }

    /// What a share of the `rows` imaginations adds to gradients and values; its graph is gone afterwards.
    fn share_gradients(
        &self,
        imagined: Imagination,
        range: ReturnRange,
        rows: usize,
    ) -> Result<(NamedTensors, NamedTensors, BehaviourUpdate), LearningError> {
        let weight = imagined.returns.dim(1)? as f64 / rows as f64;
        let actor_loss = actor_loss(&imagined, range.scale(), self.settings.entropy_scale)? * weight;
        let actor_loss = actor_loss?;
        let critic_loss = (part("critic", || self.critic_loss(&imagined))? * weight)?;
        let of =
            |loss: &Tensor, trained: Trained| Gradients::of_share(loss, &self.parameters, trained.filter());
        let (actor, critic) = if self.settings.actor_loss_reaches_critic {
            let both = of(&(&actor_loss + &critic_loss)?, Trained::Behaviour)?;
            both.into_iter().partition(|(name, _)| Trained::Actor.filter()(name))
        } else {
            let actor = part("actor backward", || of(&actor_loss, Trained::Actor))?;
            (actor, part("critic backward", || of(&critic_loss, Trained::Critic))?)
        };
        let scalar = |x: &Tensor| Ok::<_, candle_core::Error>(f64::from(x.to_scalar::<f32>()?));
        let mean = |x: &Tensor| Ok::<_, candle_core::Error>(weight * scalar(&x.mean_all()?)?);
        let values = BehaviourUpdate {
            actor_loss: scalar(&actor_loss)?,
            critic_loss: scalar(&critic_loss)?,
            entropy: mean(&imagined.entropy)?,
            reward: mean(&imagined.reward)?,
            lambda_return: mean(&imagined.returns)?,
            value: mean(&imagined.value)?,
            ..BehaviourUpdate::default()
        };
        Ok((actor, critic, values))
    }

    /// The critic's loss, in which the critic alone trains.
    pub fn critic_loss(&self, imagined: &Imagination) -> candle_core::Result<Tensor> {
        critic_loss(&self.judging.critic, &self.judging.slow_critic, imagined)
    }

    /// Moves actor and critic.
    pub fn apply(&mut self, gradients: &BehaviourGradients) -> candle_core::Result<()> {
        self.actor_adam.step(&self.parameters, &gradients.actor)?;
        self.critic_adam.step(&self.parameters, &gradients.critic)
    }

    /// The average range of the returns.
    #[must_use]
    pub fn return_range(&self) -> ReturnRange {
        self.return_range
    }

    /// The optimisers of actor and critic.
    #[must_use]
    pub fn adams(&self) -> [&Adam; 2] {
        [&self.actor_adam, &self.critic_adam]
    }

    /// Goes on from an earlier run's optimisers and range.
    pub fn resume(&mut self, actor: Adam, critic: Adam, range: ReturnRange) {
        (self.actor_adam, self.critic_adam, self.return_range) = (actor, critic, range);
    }
}
