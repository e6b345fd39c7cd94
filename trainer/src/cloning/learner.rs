use std::collections::BTreeMap;

use candle_core::Tensor;
use rcwm_models::settings::ModelSettings;
use serde::Serialize;

use super::CloningSettings;
use crate::behaviour::{BehaviourLearner, BehaviourSettings, BehaviourUpdate, ReturnRange};
use crate::learning::{Adam, Gradients, LearningError, Trained, cloning_loss};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};
use crate::model::parameters::Parameters;

/// The actor with what it takes to clone it, and the critic where imagination has a part.
#[derive(Debug, Clone)]
pub struct CloningLearner {
    agent: Agent,
    parameters: Parameters,
    settings: CloningSettings,
    imagining: BehaviourLearner,
    actor_adam: Adam,
    critic_adam: Adam,
}

/// What one update was.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CloningUpdate {
    /// The cloning loss, before its factor.
    pub loss: f64,
    /// Its factor.
    pub weight: f64,
    /// Norm of the actor's gradient, before clipping.
    pub gradient_norm: f64,
    /// Factor of the actor's loss in imagination.
    pub imagination_weight: f64,
    /// What was imagined, if anything.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub imagined: Option<BehaviourUpdate>,
}

impl CloningLearner {
    /// A learner on `parameters`, which it shares.
    ///
    /// # Errors
    /// If the parameters do not fit the model.
    pub fn new(
        parameters: &Parameters,
        model: &ModelSettings,
        settings: &CloningSettings,
        behaviour: &BehaviourSettings,
    ) -> Result<Self, LearningError> {
        Ok(Self {
            agent: Agent::new(&parameters.trainable_where(Trained::Actor.filter()), model)?,
            parameters: parameters.clone(),
            settings: settings.clone(),
            imagining: BehaviourLearner::new(parameters, model, behaviour)?,
            actor_adam: Adam::new(settings.actor.clone()),
            critic_adam: Adam::new(behaviour.critic.clone()),
        })
    }

    /// Update `number`, from 0: the actor moves towards `actions` [N, action] in the states of `features` [N, state width], and along
    /// what comes of it in imaginations from `start`, asked for only where that counts.
    ///
    /// # Errors
    /// See [`LearningError`]; actor and critic are then as they were.
    pub fn update(
        &mut self,
        number: u64,
        features: &Tensor,
        actions: &Tensor,
        start: impl FnOnce() -> candle_core::Result<State>,
        sampler: &mut Sampler,
    ) -> Result<CloningUpdate, LearningError> {
        let weight = self.settings.weight.at(number);
        let imagination_weight = self.settings.imagination_weight.at(number);
        let loss = cloning_loss(&self.agent.actor, features, actions, self.settings.loss)?;
        let mut actor = Gradients::of(&(&loss * weight)?, &self.parameters, Trained::Actor.filter())?;
        let mut imagined = None;
        if imagination_weight > 0.0 {
            self.imagining.mix_slow_critic()?;
            let imaginations = self.imagining.imagine_shares(&start()?, sampler)?;
            let gradients = self.imagining.gradients(imaginations)?;
            actor = sum(&actor, &gradients.actor, imagination_weight)?;
            self.critic_adam.step(&self.parameters, &gradients.critic)?;
            imagined = Some(gradients.values);
        }
        self.actor_adam.step(&self.parameters, &actor)?;
        Ok(CloningUpdate {
            loss: f64::from(loss.to_scalar::<f32>()?),
            weight,
            gradient_norm: actor.norm(),
            imagination_weight,
            imagined,
        })
    }

    /// The optimisers of actor and critic.
    #[must_use]
    pub fn adams(&self) -> [&Adam; 2] {
        [&self.actor_adam, &self.critic_adam]
    }

    /// The average range of the imagined returns.
    #[must_use]
    pub fn return_range(&self) -> ReturnRange {
        self.imagining.return_range()
    }

    /// Goes on from an earlier run's optimisers and range.
    pub fn resume(&mut self, actor: Adam, critic: Adam, range: ReturnRange) {
        let [own_actor, own_critic] = self.imagining.adams().map(Clone::clone);
        self.imagining.resume(own_actor, own_critic, range);
        (self.actor_adam, self.critic_adam) = (actor, critic);
    }
}

/// `a + factor b`.
fn sum(a: &Gradients, b: &Gradients, factor: f64) -> Result<Gradients, LearningError> {
    let mut tensors = BTreeMap::new();
    for (name, gradient) in a.iter() {
        let total = match b.get(name) {
            Some(other) => (gradient + (other * factor)?)?,
            None => gradient.clone(),
        };
        tensors.insert(name.to_owned(), total);
    }
    Gradients::new(tensors)
}
