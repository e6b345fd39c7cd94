use std::collections::BTreeMap;

use candle_core::{Device, Tensor};

use super::forward::{Named, batch, behaviour_settings, parameters};
use super::{Group, ParityError, Reference};
use crate::behaviour::{BehaviourGradients, BehaviourLearner};
use crate::learning::{Gradients, Trained, WorldLearner, WorldLosses, WorldSettings};
use crate::model::latent::Sampler;
use crate::model::parameters::Parameters;

/// One update of the world model and one of actor and critic, from the file's weights and inputs, by the code that trains.
pub(super) struct Updates {
    world: WorldStep,
    behaviour: BehaviourStep,
}

struct WorldStep {
    losses: WorldLosses,
    free_nats: f64,
    gradients: Gradients,
    updated: Parameters,
}

struct BehaviourStep {
    gradients: BehaviourGradients,
    updated: Parameters,
}

impl Updates {
    pub fn new(reference: &Reference, device: &Device) -> Result<Self, ParityError> {
        let batch = batch(reference, device)?;
        let updated = parameters(reference, device)?;
        let settings = WorldSettings { reward_scale: reference.reward_scale, ..WorldSettings::default() };
        let mut learner = WorldLearner::new(&updated, &reference.settings, &settings, Trained::World)?;
        let (losses, gradients) = learner.gradients(&batch, &mut Sampler::Mode)?;
        learner.apply(&resolved(reference, &gradients, device)?)?;
        // The behaviour's update has the original weights, its own copy of them.
        let start = losses.observed.posteriors.map(|x| x.detach().flatten(0, 1))?; // [B*T, ...]
        let world = WorldStep { losses, free_nats: settings.free_nats, gradients, updated };

        let updated = parameters(reference, device)?;
        let mut learner =
            BehaviourLearner::new(&updated, &reference.settings, &behaviour_settings(reference))?;
        learner.mix_slow_critic()?;
        let imagined = learner.imagine_shares(&start, &mut Sampler::Mode)?;
        let gradients = learner.gradients(imagined)?;
        learner.apply(&gradients)?;
        Ok(Self { world, behaviour: BehaviourStep { gradients, updated } })
    }

    /// The tensors of a group under the file's names.
    pub fn compute(&self, group: Group) -> Result<Named, ParityError> {
        let prefix = group.as_str();
        let behaviour = &self.behaviour.gradients;
        let values = match group {
            Group::Loss => self.losses()?,
            Group::Grad => named(self.world.gradients.iter()),
            Group::GradNorm => vec![
                ("world_model".to_owned(), scalar(self.world.gradients.norm())?),
                ("actor".to_owned(), scalar(behaviour.actor.norm())?),
                ("critic".to_owned(), scalar(behaviour.critic.norm())?),
            ],
            Group::BehaviourGrad => named(behaviour.actor.iter().chain(behaviour.critic.iter())),
            Group::Updated => {
                let trained = Trained::World.filter();
                vars(&self.world.updated, trained)
            }
            Group::BehaviourUpdated => {
                let trained = Trained::World.filter();
                vars(&self.behaviour.updated, |name| !trained(name))
            }
            _ => Vec::new(),
        };
        Ok(values.into_iter().map(|(name, value)| (format!("{prefix}/{name}"), value)).collect())
    }

    fn losses(&self) -> Result<Named, ParityError> {
        let losses = &self.world.losses;
        let behaviour = &self.behaviour.gradients.values;
        let mut named = vec![
            ("total".to_owned(), losses.total.reshape(1)?),
            ("image".to_owned(), losses.image.reshape(1)?),
            ("reward".to_owned(), losses.reward.reshape(1)?),
            ("continue".to_owned(), losses.continues.reshape(1)?),
            ("actor".to_owned(), scalar(behaviour.actor_loss)?),
            ("critic".to_owned(), scalar(behaviour.critic_loss)?),
        ];
        if let Some(mask) = &losses.robot_mask {
            named.push(("robot_mask".to_owned(), mask.reshape(1)?));
        }
        for (branch, kl) in ["robot", "environment"].into_iter().zip(&losses.branches) {
            named.push((format!("{branch}_kl"), kl.kl.clone()));
            // The halves differ in their gradients only.
            let clipped = kl.kl.maximum(self.world.free_nats)?.mean_all()?.reshape(1)?;
            named.push((format!("{branch}_dynamics"), clipped.clone()));
            named.push((format!("{branch}_representation"), clipped));
        }
        Ok(named)
    }
}

/// Our gradients, but the file's where an entry is smaller than the error that f32 excuses: Adam's first step is nearly the
/// sign of the gradient, and of such an entry not even the sign is known.
fn resolved(reference: &Reference, ours: &Gradients, device: &Device) -> Result<Gradients, ParityError> {
    let mut tensors = BTreeMap::new();
    for (name, ours) in ours.iter() {
        let theirs = reference.tensor(&format!("grad/{name}"), device)?;
        tensors.insert(
            name.to_owned(),
            unresolved(reference, name)?.to_device(device)?.where_cond(&theirs, ours)?,
        );
    }
    Ok(Gradients::new(tensors)?)
}

/// 1 where an entry of the file's gradient is smaller than the error that f32 excuses.
pub(super) fn unresolved(reference: &Reference, name: &str) -> Result<Tensor, ParityError> {
    let (_, tolerance) = Group::Grad.tolerance();
    let key = format!("grad/{name}");
    let theirs = reference.tensor(&key, &Device::Cpu)?;
    Ok(theirs.abs()?.lt(f64::from(tolerance * reference.unit(&key)?))?)
}

fn scalar(value: f64) -> Result<Tensor, candle_core::Error> {
    Tensor::new(&[value as f32], &Device::Cpu)
}

fn named<'a>(tensors: impl Iterator<Item = (&'a str, &'a Tensor)>) -> Named {
    tensors.map(|(name, tensor)| (name.to_owned(), tensor.clone())).collect()
}

fn vars(parameters: &Parameters, wanted: impl Fn(&str) -> bool) -> Named {
    let chosen = parameters.iter().filter(|(name, _)| wanted(name));
    chosen.map(|(name, var)| (name.to_owned(), var.as_tensor().clone())).collect()
}
