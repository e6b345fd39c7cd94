use candle_core::{DType, Device, Tensor};
use rcwm_gpu::weights::{Array, Group as Trained};

use super::forward::{Named, behaviour_settings, parameters};
use super::updates::unresolved;
use super::{Group, ParityError, Reference};
use crate::behaviour::BehaviourUpdate;
use crate::gpu::{GpuLearner, GpuPlan, GpuWorldUpdate, Share, numbered_noise};
use crate::learning::{HostBatch, WorldSettings};

/// One update of the world model and one of actor and critic, from the file's weights and inputs, by programs on a machine.
pub(super) struct Programs {
    world: GpuWorldUpdate,
    behaviour: BehaviourUpdate,
    free_nats: f64,
    kl: [Tensor; 2],
    gradients: Vec<(String, Trained, Tensor)>,
    updated: Vec<(String, Trained, Tensor)>,
}

impl Programs {
    pub fn new(reference: &Reference, share: &Share) -> Result<Self, ParityError> {
        let settings = WorldSettings { reward_scale: reference.reward_scale, ..WorldSettings::default() };
        let behaviour = behaviour_settings(reference);
        let plan = GpuPlan {
            model: &reference.settings,
            batch: (reference.batch, reference.length),
            world: &settings,
            imitation: None,
            in_stages: false,
            behaviour: Some(&behaviour),
            average_decay: 0.0,
            stored: &[],
            looks: false,
            mode: true,
        };
        let weights = parameters(reference, &Device::Cpu)?;
        let mut learner = GpuLearner::new(share, &plan, &weights)?;
        let world = learner.update_world(&host_batch(reference)?, numbered_noise(0, 0))?;
        let shape = (reference.length, reference.batch);
        let mut kl = |branch| -> Result<Tensor, ParityError> {
            let kl = learner.learner_mut().kl(branch).map_err(crate::learning::LearningError::from)?;
            Ok(Tensor::from_vec(kl, shape, &Device::Cpu)?.t()?.contiguous()?)
        };
        let kl = [kl(0)?, kl(1)?];
        let of_world = |group: &Trained| *group == Trained::World;
        let mut gradients = tensors(&mut learner, Array::Gradients, of_world)?;
        let mut updated = tensors(&mut learner, Array::Values, of_world)?;
        // Where a gradient is smaller than its error, Adam's first step is not known: the file's is taken.
        for ((name, _, gradient), (_, _, updated)) in gradients.iter().zip(&mut updated) {
            let lost = unresolved(reference, name)?;
            let theirs = reference.tensor(&format!("updated/{name}"), &Device::Cpu)?;
            debug_assert_eq!(gradient.dims(), theirs.dims());
            *updated = lost.where_cond(&theirs, updated)?;
        }
        // The behaviour's update has the original weights, on the states that they gave.
        learner.load(Array::Values, &weights)?;
        let (behaviour, _) = learner.update_behaviour()?;
        let acts = |group: &Trained| *group != Trained::World;
        gradients.extend(tensors(&mut learner, Array::Gradients, acts)?);
        updated.extend(tensors(&mut learner, Array::Values, acts)?);
        Ok(Self { world, behaviour, free_nats: settings.free_nats, kl, gradients, updated })
    }

    /// The tensors of a group under the file's names.
    pub fn compute(&self, group: Group) -> Result<Named, ParityError> {
        let of = |from: &[(String, Trained, Tensor)], wanted: &[Trained]| -> Named {
            let chosen = from.iter().filter(|(_, group, _)| wanted.contains(group));
            chosen.map(|(name, _, tensor)| (name.clone(), tensor.clone())).collect()
        };
        let values = match group {
            Group::Loss => self.losses()?,
            Group::Grad => of(&self.gradients, &[Trained::World]),
            Group::GradNorm => vec![
                ("world_model".to_owned(), scalar(self.world.gradient_norm)?),
                ("actor".to_owned(), scalar(self.behaviour.actor_gradient_norm)?),
                ("critic".to_owned(), scalar(self.behaviour.critic_gradient_norm)?),
            ],
            Group::BehaviourGrad => of(&self.gradients, &[Trained::Actor, Trained::Critic]),
            Group::Updated => of(&self.updated, &[Trained::World]),
            Group::BehaviourUpdated => {
                of(&self.updated, &[Trained::Actor, Trained::Critic, Trained::SlowCritic])
            }
            _ => Vec::new(),
        };
        let prefix = group.as_str();
        Ok(values.into_iter().map(|(name, value)| (format!("{prefix}/{name}"), value)).collect())
    }

    fn losses(&self) -> Result<Named, ParityError> {
        let losses = &self.world.losses;
        let mut named = vec![
            ("total".to_owned(), scalar(losses.total)?),
            ("image".to_owned(), scalar(losses.image)?),
            ("reward".to_owned(), scalar(losses.reward)?),
            ("continue".to_owned(), scalar(losses.continues)?),
            ("actor".to_owned(), scalar(self.behaviour.actor_loss)?),
            ("critic".to_owned(), scalar(self.behaviour.critic_loss)?),
        ];
        if let Some(mask) = losses.robot_mask {
            named.push(("robot_mask".to_owned(), scalar(mask)?));
        }
        for (branch, kl) in ["robot", "environment"].into_iter().zip(&self.kl) {
            named.push((format!("{branch}_kl"), kl.clone()));
            let clipped = kl.maximum(self.free_nats)?.mean_all()?.reshape(1)?;
            named.push((format!("{branch}_dynamics"), clipped.clone()));
            named.push((format!("{branch}_representation"), clipped));
        }
        Ok(named)
    }
}

/// All parameters of some groups in one of the machine's arrays.
fn tensors(
    learner: &mut GpuLearner,
    array: Array,
    wanted: impl Fn(&Trained) -> bool,
) -> Result<Vec<(String, Trained, Tensor)>, ParityError> {
    let learner = learner.learner_mut();
    let mut found = Vec::new();
    for at in 0..learner.entries().len() {
        let entry = learner.entries()[at].clone();
        if wanted(&entry.group) {
            let values = learner.get(array, at).map_err(crate::learning::LearningError::from)?;
            let tensor = Tensor::from_vec(values, entry.shape.as_slice(), &Device::Cpu)?;
            found.push((entry.name, entry.group, tensor));
        }
    }
    Ok(found)
}

/// The file's inputs as replay would make them.
fn host_batch(reference: &Reference) -> Result<HostBatch, ParityError> {
    let input = |name: &str| reference.tensor(&format!("input/{name}"), &Device::Cpu);
    let floats = |name: &str| -> Result<Vec<f32>, ParityError> {
        Ok(input(name)?.flatten_all()?.to_dtype(DType::F32)?.to_vec1()?)
    };
    let bytes = |name: &str| -> Result<Vec<u8>, ParityError> {
        Ok(floats(name)?.into_iter().map(|value| value as u8).collect())
    };
    let flags = |name: &str| -> Result<Vec<bool>, ParityError> {
        Ok(floats(name)?.into_iter().map(|value| value != 0.0).collect())
    };
    let steps = reference.batch * reference.length;
    let action = floats("action")?;
    Ok(HostBatch {
        rows: reference.batch,
        length: reference.length,
        side: reference.settings.image_side,
        image: bytes("image")?,
        masks: true,
        action,
        reward: floats("reward")?,
        terminal: flags("is_terminal")?,
        first: flags("is_first")?,
        robot_mask: bytes("robot_mask")?,
        pushed: vec![false; steps],
        ..HostBatch::default()
    })
}

fn scalar(value: f64) -> Result<Tensor, candle_core::Error> {
    Tensor::new(&[value as f32], &Device::Cpu)
}
