//! Updates on a GPU: the trainer's weights, optimisers and batches on one side, [`rcwm_gpu`]'s programs on the other.
//!
//! While a run learns there, its weights and moments live on the GPU; [`GpuLearner::write_back`] brings them to the trainer's parameters before
//! a checkpoint, a film or an evaluation.

mod share;

use std::collections::BTreeMap;

use candle_core::{Tensor, Var};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rcwm_gpu::learner::{AdamScales, Colours, Images, Noise, Seen};
use rcwm_gpu::weights::{Array, Group};
use rcwm_gpu::world::{ImitationScales, Sizes, WorldScales};
use rcwm_gpu::{BehaviourValues, GpuError, Learner, LearnerSettings, WorldValues};
use rcwm_models::settings::{ModelKind, ModelSettings};

use crate::behaviour::{BehaviourSettings, BehaviourUpdate, ReturnRange};
use crate::learning::{
    Adam, AdamSettings, CloningLoss, HostBatch, Imitation, Jitter, LearningError, LossValues, Moments, Side,
    WorldSettings, side_of,
};
use crate::model::agent;
use crate::model::parameters::Parameters;
use crate::ops;
use crate::replay::Placed;

pub use share::Share;

/// What a learner on a GPU is made for.
#[derive(Debug, Clone)]
pub struct GpuPlan<'a> {
    /// The sizes of the model.
    pub model: &'a ModelSettings,
    /// B and T of every batch.
    pub batch: (usize, usize),
    /// The world model's losses and optimiser.
    pub world: &'a WorldSettings,
    /// The actor's part in the world model's loss, where it has one.
    pub imitation: Option<Imitation>,
    /// Whether some updates are of the environment's side alone.
    pub in_stages: bool,
    /// Actor and critic, where they learn.
    pub behaviour: Option<&'a BehaviourSettings>,
    /// Decay of the running average of the weights; 0: none.
    pub average_decay: f64,
    /// Episodes whose images, and masks where they have any, are kept on the GPU; none: every batch brings its own.
    pub stored: &'a [Placed],
    /// Whether batches say that the encoders see other pictures than those that are decoded.
    pub looks: bool,
    /// Whether draws are the most probable class and actions the mean: for comparisons.
    pub mode: bool,
}

/// World model, actor and critic on a GPU.
#[derive(Debug)]
pub struct GpuLearner {
    learner: Learner,
    kind: ModelKind,
    world: WorldSettings,
    imitation: Option<Imitation>,
    behaviour: Option<BehaviourSettings>,
}

/// What one update of the world model was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GpuWorldUpdate {
    /// The losses before it.
    pub losses: LossValues,
    /// Norm of the gradients before clipping.
    pub gradient_norm: f64,
}

/// Which generator an update's noise comes from, as [`Sampler::numbered`](crate::model::latent::Sampler::numbered) has it.
#[must_use]
pub fn numbered_noise(seed: u64, number: u64) -> Noise {
    Noise { key: ChaCha8Rng::seed_from_u64(seed).get_seed(), stream: number }
}

fn adam_scales(settings: &AdamSettings) -> AdamScales {
    let AdamSettings { eps, clip_norm, beta1, beta2, .. } = *settings;
    AdamScales { eps: eps as f32, clip_norm: clip_norm as f32, beta1, beta2 }
}

impl GpuLearner {
    /// The learner of a share of a machine, with these weights and optimisers that have seen nothing.
    ///
    /// # Errors
    /// [`LearningError`], also where the settings ask for what updates on a GPU do not do.
    pub fn new(share: &Share, plan: &GpuPlan<'_>, parameters: &Parameters) -> Result<Self, LearningError> {
        let GpuPlan { model, world, behaviour, stored, .. } = plan;
        let sizes = Sizes {
            model: (*model).clone(),
            batch: plan.batch.0,
            length: plan.batch.1,
            decode_every: world.decode_every,
            mode: plan.mode,
            looks: plan.looks,
        };
        let scales = WorldScales {
            image: world.image_scale as f32,
            mask: world.mask_scale as f32,
            reward: world.reward_scale as f32,
            continues: world.continue_scale as f32,
            dynamics: world.dynamics_scale as f32,
            representation: world.representation_scale as f32,
            free_nats: world.free_nats as f32,
        };
        let settings = LearnerSettings {
            sizes,
            world: scales,
            world_adam: adam_scales(&world.adam),
            imitation: plan.imitation.map(|imitation| ImitationScales {
                scale: imitation.scale as f32,
                likelihood: imitation.loss == CloningLoss::Likelihood,
            }),
            in_stages: plan.in_stages,
            behaviour: behaviour.map(|behaviour| {
                (behaviour_scales(behaviour), adam_scales(&behaviour.actor), adam_scales(&behaviour.critic))
            }),
            average_decay: plan.average_decay,
            stored_images: stored.iter().map(Placed::end).max().unwrap_or(0),
            stored_masks: stored.iter().any(|placed| placed.episode.robot_mask.is_some()),
        };
        let specs: Vec<_> = agent::specs(model)?.into_iter().map(|spec| (spec.name, spec.shape)).collect();
        let bins: Vec<f32> = ops::bins(model.bins).collect();
        let bring = |learner: &mut Learner| stored.iter().try_for_each(|placed| store(learner, placed));
        let learner = share.learner(&specs, &bins, settings, bring)?;
        let kind = model.kind;
        let (world, behaviour, imitation) = ((*world).clone(), behaviour.cloned(), plan.imitation);
        let mut this = Self { learner, kind, world, imitation, behaviour };
        this.load(Array::Values, parameters)?;
        this.load(Array::Average, parameters)?;
        Ok(this)
    }

    /// The programs and their memory.
    pub fn learner_mut(&mut self) -> &mut Learner {
        &mut self.learner
    }

    /// Sets the weights or their average.
    pub fn load(&mut self, array: Array, parameters: &Parameters) -> Result<(), LearningError> {
        for at in 0..self.learner.entries().len() {
            let name = self.learner.entries()[at].name.clone();
            let Some(var) = parameters.get(&name) else { continue };
            let values = var.flatten_all()?.to_vec1::<f32>()?;
            self.learner.set(array, at, &values)?;
        }
        Ok(())
    }

    /// Goes on with an optimiser's moments.
    pub fn resume(&mut self, adam: &Adam) -> Result<(), LearningError> {
        for at in 0..self.learner.entries().len() {
            let Some(moments) = adam.moments().get(&self.learner.entries()[at].name) else {
                continue;
            };
            self.learner.set(Array::First, at, &moments.first.flatten_all()?.to_vec1::<f32>()?)?;
            self.learner.set(Array::Second, at, &moments.second.flatten_all()?.to_vec1::<f32>()?)?;
            self.learner.set_steps(at, moments.steps);
        }
        Ok(())
    }

    /// Goes on with the returns' running range.
    pub fn resume_range(&mut self, range: ReturnRange) -> Result<(), LearningError> {
        Ok(self.learner.set_range([range.low, range.high])?)
    }

    /// Brings the weights, or their average, to `parameters`.
    pub fn write_back(&mut self, array: Array, parameters: &Parameters) -> Result<(), LearningError> {
        for at in 0..self.learner.entries().len() {
            let name = self.learner.entries()[at].name.clone();
            let Some(var) = parameters.get(&name) else { continue };
            let values = self.learner.get(array, at)?;
            var.set(&Tensor::from_vec(values, var.shape(), parameters.device())?)?;
        }
        Ok(())
    }

    /// The optimiser of the world model (with the actor, where it has a part in the loss), the actor or the critic as it is now.
    pub fn adam(&mut self, group: Group, parameters: &Parameters) -> Result<Adam, LearningError> {
        let with_actor = group == Group::World && self.imitation.is_some();
        let belongs = |of: Group| of == group || with_actor && of == Group::Actor;
        let mut all = BTreeMap::new();
        for at in 0..self.learner.entries().len() {
            let entry = self.learner.entries()[at].clone();
            let steps = self.learner.steps(at);
            if !belongs(entry.group) || steps == 0 {
                continue;
            }
            let var = |values: Vec<f32>| {
                Var::from_tensor(&Tensor::from_vec(values, entry.shape.as_slice(), parameters.device())?)
            };
            let first = var(self.learner.get(Array::First, at)?)?;
            let second = var(self.learner.get(Array::Second, at)?)?;
            all.insert(entry.name, Moments { first, second, steps });
        }
        let settings = match (group, &self.behaviour) {
            (Group::Actor, Some(behaviour)) => &behaviour.actor,
            (Group::Critic, Some(behaviour)) => &behaviour.critic,
            _ => &self.world.adam,
        };
        Ok(Adam::resumed(settings.clone(), all))
    }

    /// One update of the world model from a batch.
    ///
    /// # Errors
    /// [`LearningError::NotFinite`], where the parameters are then as they were, or those of the GPU.
    pub fn update_world(&mut self, batch: &HostBatch, noise: Noise) -> Result<GpuWorldUpdate, LearningError> {
        let images = Images::Host(&batch.image, &batch.robot_mask);
        self.update_world_from(batch, images, &[], noise)
    }

    /// The same, with the images where `images` says, shifted row by row.
    pub fn update_world_from(
        &mut self,
        batch: &HostBatch,
        images: Images<'_>,
        shift: &[[i32; 2]],
        noise: Noise,
    ) -> Result<GpuWorldUpdate, LearningError> {
        self.update_from(batch, (images, shift), noise, false)
    }

    /// One update of the environment's side alone, and of the actor where it has a part in the loss, from a batch that brings its images.
    ///
    /// # Errors
    /// As [`GpuLearner::update_world`].
    pub fn update_environment(
        &mut self,
        batch: &HostBatch,
        noise: Noise,
    ) -> Result<GpuWorldUpdate, LearningError> {
        let images = Images::Host(&batch.image, &batch.robot_mask);
        self.update_from(batch, (images, &[]), noise, true)
    }

    fn update_from(
        &mut self,
        batch: &HostBatch,
        (images, shift): (Images<'_>, &[[i32; 2]]),
        noise: Noise,
        environment_alone: bool,
    ) -> Result<GpuWorldUpdate, LearningError> {
        let (rate, environment) = (self.world.adam.learning_rate, self.world.environment_learning_rate);
        let of_actor = self.imitation.map_or(rate, |imitation| imitation.learning_rate);
        let colours = colours(batch);
        let examples = if self.imitation.is_some() { batch.examples() } else { Vec::new() };
        let batch = rcwm_gpu::Batch {
            examples: &examples,
            environment_alone,
            ..on_gpu(batch, images, &colours, shift)
        };
        let values = self.learner.update_world(&batch, noise, |name| match side_of(name) {
            Side::Environment if environment > 0.0 => environment,
            Side::Actor => of_actor,
            _ => rate,
        })?;
        finite("the loss", values.total)?;
        finite("the norm of the gradients", values.gradient_norm)?;
        moved(values.moved)?;
        Ok(GpuWorldUpdate { losses: self.losses(values), gradient_norm: values.gradient_norm })
    }

    /// The world model's losses of a batch.
    pub fn validate_world(
        &mut self,
        batch: &HostBatch,
        images: Images<'_>,
        noise: Noise,
    ) -> Result<LossValues, LearningError> {
        let values = self.learner.validate_world(&on_gpu(batch, images, &colours(batch), &[]), noise)?;
        Ok(self.losses(values))
    }

    /// One update of actor and critic from the last batch's posterior states.
    ///
    /// # Errors
    /// [`LearningError::NotFinite`], or those of the GPU.
    pub fn update_behaviour(&mut self) -> Result<(BehaviourUpdate, ReturnRange), LearningError> {
        let rates = self.behaviour.as_ref().map(|b| (b.actor.learning_rate, b.critic.learning_rate));
        let (actor, critic) = rates.unwrap_or_default();
        let values = self
            .learner
            .update_behaviour(|name| if side_of(name) == Side::Actor { actor } else { critic })?;
        let BehaviourValues { actor_gradient_norm, critic_gradient_norm, range: [low, high], .. } = values;
        finite("the norm of the actor's gradients", actor_gradient_norm)?;
        finite("the norm of the critic's gradients", critic_gradient_norm)?;
        moved(values.moved)?;
        let range = ReturnRange { low, high };
        let update = BehaviourUpdate {
            actor_loss: values.actor_loss,
            critic_loss: values.critic_loss,
            actor_gradient_norm,
            critic_gradient_norm,
            entropy: values.entropy,
            reward: values.reward,
            lambda_return: values.lambda_return,
            value: values.value,
            return_scale: range.scale(),
        };
        Ok((update, range))
    }

    fn losses(&self, values: WorldValues) -> LossValues {
        LossValues {
            total: values.total,
            image: values.image,
            robot_mask: values.robot_mask,
            state: None,
            reward: values.reward,
            continues: values.continues,
            cloning: values.cloning,
            robot_kl: values.kl[0],
            environment_kl: (self.kind == ModelKind::Rcwm).then_some(values.kl[1]),
        }
    }
}

/// Puts an episode's images and masks where they belong, and its disturbed pictures where they have a place.
fn store(learner: &mut Learner, placed: &Placed) -> Result<(), GpuError> {
    let Placed { episode, images: at, seen } = placed;
    let images: Vec<u8> = episode.image.iter().copied().collect();
    let masks: Vec<u8> = episode.robot_mask.iter().flatten().map(|robot| u8::from(*robot)).collect();
    learner.store(*at as usize, &images, &masks)?;
    match &episode.disturbed {
        Some(pictures) if seen != at => {
            let pictures: Vec<u8> = pictures.iter().copied().collect();
            learner.store(*seen as usize, &pictures, &[])
        }
        _ => Ok(()),
    }
}

fn behaviour_scales(settings: &BehaviourSettings) -> rcwm_gpu::behaviour::BehaviourScales {
    rcwm_gpu::behaviour::BehaviourScales {
        length: settings.horizon.length,
        discount: settings.horizon.discount as f32,
        lambda: settings.horizon.lambda as f32,
        entropy: settings.entropy_scale as f32,
        quantiles: [settings.return_range_low as f32, settings.return_range_high as f32],
        range_share: settings.return_range_share as f32,
        slow_share: settings.slow_critic_share as f32,
        actor_loss_reaches_critic: settings.actor_loss_reaches_critic,
    }
}

/// How the colours of each sequence change.
fn colours(batch: &HostBatch) -> Vec<Option<Colours>> {
    let of = |jitter: Jitter| Colours { gain: jitter.gain, offset: jitter.offset, grey: jitter.grey };
    batch.seen_jitter.iter().map(|jitter| jitter.map(of)).collect()
}

fn on_gpu<'a>(
    batch: &'a HostBatch,
    images: Images<'a>,
    colours: &'a [Option<Colours>],
    shift: &'a [[i32; 2]],
) -> rcwm_gpu::Batch<'a> {
    rcwm_gpu::Batch {
        images,
        seen: Seen { host: &batch.seen, stored: &batch.seen_place, colours },
        action: &batch.action,
        reward: &batch.reward,
        terminal: &batch.terminal,
        first: &batch.first,
        examples: &[],
        environment_alone: false,
        masks: batch.masks,
        number: batch.number,
        shift,
    }
}

/// Where something that the host does not see was not finite, nothing moved.
fn moved(moved: bool) -> Result<(), LearningError> {
    if moved { Ok(()) } else { Err(LearningError::NotFinite { what: "a loss", value: f64::NAN }) }
}

fn finite(what: &'static str, value: f64) -> Result<(), LearningError> {
    if value.is_finite() { Ok(()) } else { Err(LearningError::NotFinite { what, value }) }
}
