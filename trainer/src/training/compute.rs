//! Where a run's updates are computed, and who makes them.

use candle_core::Device;
use rcwm_gpu::Machine;
use rcwm_gpu::learner::Images;
use rcwm_gpu::weights::{Array, Group};

use super::{Run, TrainingError, TrainingSettings};
use crate::behaviour::{BehaviourLearner, BehaviourUpdate, ReturnRange};
use crate::gpu::{GpuLearner, GpuPlan, Share, numbered_noise};
use crate::learning::{Adam, HostBatch, Imitation, LossValues, Trained, WorldLearner};
use crate::model::latent::Sampler;
use crate::model::parameters::Parameters;
use crate::replay::Replay;

/// Where updates are computed.
#[derive(Debug)]
pub enum Compute {
    /// By candle's tensors and the fused ops.
    Tensors(Device),
    /// By programs of kernels. Everything that is no update, films for example, stays on the CPU.
    Programs(Share),
}

impl Compute {
    /// The machine's programs, for all runs that it was made for.
    #[must_use]
    pub fn programs(machine: Machine) -> Vec<Self> {
        Share::all(machine).into_iter().map(Self::Programs).collect()
    }
}

impl From<&Device> for Compute {
    fn from(device: &Device) -> Self {
        Self::Tensors(device.clone())
    }
}

impl Compute {
    /// Where the run's tensors live.
    #[must_use]
    pub fn device(&self) -> Device {
        match self {
            Self::Tensors(device) => device.clone(),
            Self::Programs(_) => Device::Cpu,
        }
    }
}

/// What one update of the world model said.
#[derive(Debug, Clone, Copy)]
pub(super) struct WorldStep {
    pub losses: LossValues,
    pub gradient_norm: f64,
}

/// Who makes the world model's updates.
#[derive(Debug)]
pub(super) enum WorldUpdates {
    Tensors {
        learner: Box<WorldLearner>,
        device: Device,
    },
    /// The programs are laid out when the replay is known.
    Waiting {
        share: Share,
        adam: Adam,
    },
    Programs {
        learner: Box<GpuLearner>,
        /// Whether updates are of the environment's side alone for now.
        environment: bool,
    },
    /// The world model's part of the run is over, and the programs are gone.
    Done {
        adam: Adam,
    },
}

impl WorldUpdates {
    /// A learner of `parameters` whose optimiser goes on from `adam`.
    pub fn new(
        compute: Compute,
        settings: &TrainingSettings,
        parameters: &Parameters,
        adam: Option<Adam>,
    ) -> Result<Self, TrainingError> {
        Ok(match compute {
            Compute::Tensors(device) => {
                let mut learner =
                    WorldLearner::new(parameters, &settings.model, &settings.world, Trained::World)?;
                if let Some(adam) = adam {
                    *learner.adam_mut() = adam;
                }
                Self::Tensors { learner: Box::new(learner), device }
            }
            Compute::Programs(share) => {
                let adam = adam.unwrap_or_else(|| Adam::new(settings.world.adam.clone()));
                Self::Waiting { share, adam }
            }
        })
    }

    /// Takes the images of both replays to where the programs run.
    pub fn begin(
        &mut self,
        settings: &TrainingSettings,
        parameters: &Parameters,
        run: &Run,
        replays: [&mut Replay; 2],
    ) -> Result<(), TrainingError> {
        let Self::Waiting { share, adam } = self else { return Ok(()) };
        let disturbed = settings.replay.look.disturbed > 0.0;
        let mut steps = 0;
        let mut episodes = Vec::new();
        for replay in replays {
            steps = replay.place_images(steps, disturbed, |placed| episodes.push(placed));
        }
        let plan = GpuPlan {
            model: &settings.model,
            batch: (settings.replay.batch, settings.replay.length),
            world: &settings.world,
            imitation: None,
            in_stages: false,
            behaviour: None,
            average_decay: settings.average_decay,
            stored: &episodes,
            looks: !settings.replay.look.is_plain(),
            mode: false,
        };
        let learner = Self::learner(share, &plan, (parameters, run), adam)?;
        *self = Self::Programs { learner, environment: false };
        Ok(())
    }

    /// Trains this part of the model from now on, the actor with it where it has a part in the loss. Batches bring their images.
    pub fn train(
        &mut self,
        settings: &TrainingSettings,
        (parameters, run): (&Parameters, &Run),
        trained: Trained,
        imitation: Option<Imitation>,
    ) -> Result<(), TrainingError> {
        let alone = matches!(trained, Trained::Environment | Trained::EnvironmentAndActor);
        match self {
            Self::Tensors { learner, .. } => learner.train(trained, imitation)?,
            Self::Programs { environment, .. } => *environment = alone,
            Self::Waiting { share, adam } => {
                let plan = GpuPlan {
                    model: &settings.model,
                    batch: (settings.replay.batch, settings.replay.length),
                    world: &settings.world,
                    imitation,
                    in_stages: true,
                    behaviour: None,
                    average_decay: settings.average_decay,
                    stored: &[],
                    looks: !settings.replay.look.is_plain(),
                    mode: false,
                };
                let learner = Self::learner(share, &plan, (parameters, run), adam)?;
                *self = Self::Programs { learner, environment: alone };
            }
            Self::Done { .. } => unreachable!("the world model's stages come before the actor's"),
        }
        Ok(())
    }

    fn learner(
        share: &Share,
        plan: &GpuPlan<'_>,
        (parameters, run): (&Parameters, &Run),
        adam: &Adam,
    ) -> Result<Box<GpuLearner>, TrainingError> {
        let mut learner = GpuLearner::new(share, plan, parameters)?;
        learner.load(Array::Average, &run.ema_weights(parameters))?;
        learner.resume(adam)?;
        Ok(Box::new(learner))
    }

    /// Brings everything back from where programs run; the world model learns no more.
    pub fn finish(&mut self, parameters: &Parameters, run: &mut Run) -> Result<(), TrainingError> {
        if !matches!(self, Self::Tensors { .. }) {
            *self = Self::Done { adam: self.write_back(parameters, run)? };
        }
        Ok(())
    }

    /// One update from a batch with the noise of this number.
    pub fn update(&mut self, batch: HostBatch, seed: u64, number: u64) -> Result<WorldStep, TrainingError> {
        match self {
            Self::Tensors { learner, device } => {
                let batch = batch.into_tensors(device)?;
                let update = learner.update(&batch, &mut Sampler::numbered(seed, number))?;
                Ok(WorldStep { losses: update.losses, gradient_norm: update.gradient_norm })
            }
            Self::Programs { learner, environment } => {
                let noise = numbered_noise(seed, number);
                let update = match (*environment, batch.place.is_empty()) {
                    (true, _) => learner.update_environment(&batch, noise)?,
                    (false, true) => learner.update_world(&batch, noise)?,
                    (false, false) => {
                        learner.update_world_from(&batch, Images::Stored(&batch.place), &[], noise)?
                    }
                };
                Ok(WorldStep { losses: update.losses, gradient_norm: update.gradient_norm })
            }
            Self::Waiting { .. } | Self::Done { .. } => unreachable!("a run begins before it updates"),
        }
    }

    /// The losses of a batch, where the programs run; none where the trainer's own model must be asked.
    pub fn validate(
        &mut self,
        batch: &HostBatch,
        seed: u64,
        number: u64,
    ) -> Result<Option<LossValues>, TrainingError> {
        let Self::Programs { learner, .. } = self else { return Ok(None) };
        let images = Images::Stored(&batch.place);
        Ok(Some(learner.validate_world(batch, images, numbered_noise(seed, number))?))
    }

    /// Brings the weights to `parameters`, and their average to the run's, before a checkpoint; the optimiser as it is now.
    pub fn write_back(&mut self, parameters: &Parameters, run: &mut Run) -> Result<Adam, TrainingError> {
        match self {
            Self::Tensors { learner, .. } => Ok(learner.adam().clone()),
            Self::Waiting { adam, .. } | Self::Done { adam } => Ok(adam.clone()),
            Self::Programs { learner, .. } => {
                learner.write_back(Array::Values, parameters)?;
                if let Some(average) = run.average_of(parameters)? {
                    learner.write_back(Array::Average, &average)?;
                }
                Ok(learner.adam(Group::World, parameters)?)
            }
        }
    }

    /// Whether the run's average must be moved after an update; programs move their own.
    pub fn leaves_average(&self) -> bool {
        !matches!(self, Self::Programs { .. })
    }
}

/// Who makes the updates of a run that acts: world model, actor and critic.
#[derive(Debug)]
pub(super) enum AgentUpdates {
    Tensors { world: Box<WorldLearner>, behaviour: Box<BehaviourLearner>, device: Device },
    Programs { learner: Box<GpuLearner>, range: ReturnRange },
}

impl AgentUpdates {
    /// Learners of `parameters` that have seen nothing.
    pub fn new(
        compute: Compute,
        settings: &TrainingSettings,
        parameters: &Parameters,
    ) -> Result<Self, TrainingError> {
        let TrainingSettings { model, world, behaviour, .. } = settings;
        Ok(match compute {
            Compute::Tensors(device) => Self::Tensors {
                world: Box::new(WorldLearner::new(parameters, model, world, Trained::World)?),
                behaviour: Box::new(BehaviourLearner::new(parameters, model, behaviour)?),
                device,
            },
            Compute::Programs(share) => {
                let plan = GpuPlan {
                    model,
                    batch: (settings.replay.batch, settings.replay.length),
                    world,
                    imitation: None,
                    in_stages: false,
                    behaviour: Some(behaviour),
                    average_decay: 0.0,
                    stored: &[],
                    looks: !settings.replay.look.is_plain(),
                    mode: false,
                };
                let learner = Box::new(GpuLearner::new(&share, &plan, parameters)?);
                Self::Programs { learner, range: ReturnRange::default() }
            }
        })
    }

    /// Goes on from the optimisers of world model, actor and critic, and the returns' range.
    pub fn resume(&mut self, adams: [Adam; 3], range: ReturnRange) -> Result<(), TrainingError> {
        match self {
            Self::Tensors { world, behaviour, .. } => {
                let [of_world, actor, critic] = adams;
                *world.adam_mut() = of_world;
                behaviour.resume(actor, critic, range);
            }
            Self::Programs { learner, range: here } => {
                for adam in &adams {
                    learner.resume(adam)?;
                }
                learner.resume_range(range)?;
                *here = range;
            }
        }
        Ok(())
    }

    /// One update of the world model, and of actor and critic where `behaves`, with the noise of this number.
    pub fn update(
        &mut self,
        batch: HostBatch,
        (seed, number): (u64, u64),
        behaves: bool,
    ) -> Result<(WorldStep, Option<BehaviourUpdate>), TrainingError> {
        match self {
            Self::Tensors { world, behaviour, device } => {
                let batch = batch.into_tensors(device)?;
                let mut sampler = Sampler::numbered(seed, number);
                let update = world.update(&batch, &mut sampler)?;
                let step = WorldStep { losses: update.losses, gradient_norm: update.gradient_norm };
                if !behaves {
                    return Ok((step, None));
                }
                let start = update.posteriors.map(|x| x.flatten(0, 1))?; // [B*T, ...]
                Ok((step, Some(behaviour.update(&start, &mut sampler)?)))
            }
            Self::Programs { learner, range } => {
                let update = learner.update_world(&batch, numbered_noise(seed, number))?;
                let step = WorldStep { losses: update.losses, gradient_norm: update.gradient_norm };
                if !behaves {
                    return Ok((step, None));
                }
                let (behaviour, now) = learner.update_behaviour()?;
                *range = now;
                Ok((step, Some(behaviour)))
            }
        }
    }

    /// Brings the weights to `parameters`, where they are elsewhere.
    pub fn write_back(&mut self, parameters: &Parameters) -> Result<(), TrainingError> {
        match self {
            Self::Tensors { .. } => Ok(()),
            Self::Programs { learner, .. } => Ok(learner.write_back(Array::Values, parameters)?),
        }
    }

    /// The optimisers of world model, actor and critic as they are now.
    pub fn adams(&mut self, parameters: &Parameters) -> Result<[Adam; 3], TrainingError> {
        match self {
            Self::Tensors { world, behaviour, .. } => {
                let [actor, critic] = behaviour.adams();
                Ok([world.adam().clone(), actor.clone(), critic.clone()])
            }
            Self::Programs { learner, .. } => Ok([
                learner.adam(Group::World, parameters)?,
                learner.adam(Group::Actor, parameters)?,
                learner.adam(Group::Critic, parameters)?,
            ]),
        }
    }

    /// The returns' running range.
    pub fn return_range(&self) -> ReturnRange {
        match self {
            Self::Tensors { behaviour, .. } => behaviour.return_range(),
            Self::Programs { range, .. } => *range,
        }
    }
}
