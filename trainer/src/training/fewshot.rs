use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use candle_core::{Device, Tensor};
use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelKind;
use serde_json::json;

use super::compute::{Compute, WorldUpdates};
use super::update_loop::{Core, Outcome, Progress, Updated, Updates, make_all_updates};
use super::{
    Best, FewshotSettings, HeldOutLosses, Phase, TimeBucket, TrainingError, TrainingSettings, start_from,
};
use crate::checkpoint::Checkpoint;
use crate::cloning::{CloningLearner, CloningSettings};
use crate::learning::{
    Adam, Examples, Imitation, Side, Trained, Views, cloning_loss, side_of, state_of_features,
};
use crate::model::agent::Agent;
use crate::model::latent::Sampler;
use crate::model::parameters::Parameters;
use crate::replay::{Prefetch, Replay};

/// Names of the optimisers in checkpoints.
const OPTIMISERS: [&str; 3] = ["world", "actor", "critic"];
/// What sets the streams of draws apart under one seed.
const REPLAY_STREAM: u64 = 0x7265_706c_6179;
const EXAMPLES_STREAM: u64 = 0x0065_7861_6d70;
const ROWS_STREAM: u64 = 0x0072_6f77_7300;

/// What an update of few-shot learning trains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// The environment's side alone.
    Environment,
    /// The whole world model.
    World,
    Actor,
}

impl Stage {
    /// The stage of update `number`, from 0, and the number within it.
    #[must_use]
    pub fn of(settings: &FewshotSettings, number: u64) -> (Self, u64) {
        let (environment, world) = (settings.environment_updates, settings.world_updates);
        if number < environment {
            (Self::Environment, number)
        } else if number < environment + world {
            (Self::World, number - environment)
        } else {
            (Self::Actor, number - environment - world)
        }
    }

    /// Its name in metrics.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Environment => "environment",
            Self::World => "world",
            Self::Actor => "actor",
        }
    }

    /// What of the world model it trains.
    fn trained(self, kind: ModelKind, imitates: bool) -> Trained {
        match (self, kind, imitates) {
            (Self::Environment, ModelKind::Rcwm, false) => Trained::Environment,
            (Self::Environment, ModelKind::Rcwm, true) => Trained::EnvironmentAndActor,
            (_, _, true) => Trained::WorldAndActor,
            (_, _, false) => Trained::World,
        }
    }
}

/// A new task from demonstrations alone: see [`FewshotSettings`].
#[derive(Debug)]
pub struct Fewshot {
    core: Core,
    world: WorldUpdates,
    cloning: CloningLearner,
}

impl Fewshot {
    /// A new run in `folder`, from a pre-trained model.
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        source: &Checkpoint,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        if source.settings.model != settings.model {
            settings.validate()?;
            return Err(TrainingError::OtherModel);
        }
        let begin = |settings: &TrainingSettings, device: &Device| {
            Ok(start_from(source, &settings.reset, settings.seed, device)?)
        };
        Self::of(Core::create(folder, settings, compute.device(), begin)?, compute, None)
    }

    fn of(core: Core, compute: Compute, adam: Option<Adam>) -> Result<Self, TrainingError> {
        let TrainingSettings { model, behaviour, fewshot, .. } = &core.settings;
        if fewshot.world_goes_on && matches!(compute, Compute::Programs(_)) {
            return Err(TrainingError::GoesOnOnGpu);
        }
        let world = WorldUpdates::new(compute, &core.settings, &core.parameters, adam)?;
        let cloning = CloningLearner::new(&core.parameters, model, &fewshot.cloning, behaviour)?;
        Ok(Self { core, world, cloning })
    }

    /// Goes on with the run in `folder` from its newest checkpoint, or from the beginning if there is none yet.
    pub fn resume(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        let begin = |settings: &TrainingSettings, device: &Device| {
            let source = Checkpoint::read(&settings.from, device)?;
            Ok(start_from(&source, &settings.reset, settings.seed, device)?)
        };
        let (core, moments) = Core::resume(folder, settings, compute.device(), &[Phase::Fewshot], begin)?;
        let [of_world, actor, critic] = OPTIMISERS;
        let adam = core.adam(of_world, &core.settings.world.adam, &moments)?;
        let mut this = Self::of(core, compute, adam)?;
        let Self { core, cloning, .. } = &mut this;
        let settings = &core.settings;
        let actor = core.adam(actor, &settings.fewshot.cloning.actor, &moments)?;
        let critic = core.adam(critic, &settings.behaviour.critic, &moments)?;
        if let (Some(actor), Some(critic)) = (actor, critic) {
            cloning.resume(actor, critic, core.state.return_range);
        }
        Ok(this)
    }

    /// Updates made so far.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.core.state.updates
    }

    /// The parameters, as they are.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.core.parameters
    }

    /// Learns from the demonstrations in `replay` until all updates are made or `stop` is set; either way ends with a checkpoint.
    ///
    /// # Errors
    /// See [`TrainingError`]; the newest checkpoint is then the last good one.
    pub fn run(
        &mut self,
        replay: Replay,
        stop: &AtomicBool,
        show: impl FnMut(&Progress<'_>),
    ) -> Result<Outcome, TrainingError> {
        let Self { core, world, cloning } = self;
        let settings = &core.settings;
        let (replay, held_out) = replay.hold_out(settings.fewshot.held_out);
        core.scenes = settings.film.scenes(if held_out.episodes() > 0 { &held_out } else { &replay });
        let of = |replay: &Replay| replay.tasks().flat_map(|(_, episodes)| episodes).cloned().collect();
        let (episodes, held_out) = (of(&replay), of(&held_out));
        let until = settings.fewshot.updates();
        let (stage, batches, examples) = (None, None, None);
        let mut running =
            Running { core, world, cloning, replay, episodes, held_out, stage, batches, examples };
        make_all_updates(&mut running, until, stop, show)
    }
}

/// Few-shot learning under way.
struct Running<'a> {
    core: &'a mut Core,
    world: &'a mut WorldUpdates,
    cloning: &'a mut CloningLearner,
    replay: Replay,
    /// The demonstrations.
    episodes: Vec<Arc<Episode>>,
    /// Demonstrations that are not learned from.
    held_out: Vec<Arc<Episode>>,
    stage: Option<Stage>,
    /// What the present stage works on.
    batches: Option<Prefetch>,
    examples: Option<Examples>,
}

impl Updates for Running<'_> {
    fn core(&mut self) -> &mut Core {
        self.core
    }

    fn update(&mut self) -> Result<Updated, TrainingError> {
        let (stage, number) = Stage::of(&self.core.settings.fewshot, self.core.state.updates);
        if self.stage != Some(stage) {
            self.enter(stage, number)?;
        }
        self.update_in(stage, number)?;
        Ok((stage.name(), self.world.leaves_average().then(|| self.moved(stage))))
    }

    fn save(&mut self) -> Result<Option<HeldOutLosses>, TrainingError> {
        let adam = self.world.write_back(&self.core.parameters, &mut self.core.run)?;
        let agent = self.core.agent()?;
        if !self.held_out.is_empty() {
            let cloning = self.held_out_cloning(&agent)?;
            let update = self.core.state.updates;
            self.core.run.log(&json!({"update": update, "held_out": {"cloning": cloning}}))?;
        }
        let Self { core, cloning, .. } = self;
        core.state.return_range = cloning.return_range();
        let [actor, critic] = cloning.adams();
        let optimisers: Vec<_> = OPTIMISERS.into_iter().zip([&adam, actor, critic]).collect();
        core.write(&agent, &optimisers, Best::No, 0)?;
        Ok(None)
    }
}

impl Running<'_> {
    /// Which parameters an update of the stage may move.
    fn moved(&self, stage: Stage) -> fn(&str) -> bool {
        match stage {
            Stage::Actor if !self.core.settings.fewshot.world_goes_on => {
                |name| matches!(side_of(name), Side::Actor | Side::Critic | Side::SlowCritic)
            }
            _ => |_| true,
        }
    }

    /// Prepares what the stage needs from its update `number` on.
    fn enter(&mut self, stage: Stage, number: u64) -> Result<(), TrainingError> {
        self.stage = Some(stage);
        if stage == Stage::Actor && !self.core.settings.fewshot.world_goes_on {
            self.world.finish(&self.core.parameters, &mut self.core.run)?;
        }
        let core = &*self.core;
        if stage == Stage::Actor && number == 0 {
            // The actor learns on the states that the deployed world model will give it.
            core.parameters.mix(&core.run.ema_weights(&core.parameters), 1.0, |_| true)?;
        }
        let fewshot = &core.settings.fewshot;
        let imitation = Imitation {
            scale: fewshot.imitation_scale,
            loss: fewshot.cloning.loss,
            learning_rate: core.settings.world.adam.learning_rate,
        };
        let imitation = (stage != Stage::Actor && imitation.scale > 0.0).then_some(imitation);
        let seed = core.settings.seed;
        if stage != Stage::Actor || fewshot.world_goes_on {
            let trained = stage.trained(core.settings.model.kind, imitation.is_some());
            self.world.train(&core.settings, (&core.parameters, &core.run), trained, imitation)?;
            if self.batches.is_none() {
                let (sizes, mut replay) = (core.settings.replay.clone(), self.replay.clone());
                replay.look(&sizes.look);
                let (shift, starts) = (fewshot.shift, fewshot.starts);
                self.batches = Some(Prefetch::start(core.state.updates, sizes.prefetch, move |number| {
                    let seed = seed ^ REPLAY_STREAM;
                    let mut batch =
                        replay.draw_from(starts, sizes.batch, sizes.length, false, seed, number)?;
                    batch.shift(shift, seed, number);
                    Ok(batch)
                })?);
            }
            return Ok(());
        }
        self.batches = None;
        let agent = Agent::new(&core.parameters.frozen(), &core.settings.model)?;
        let views =
            Views { draws: fewshot.cloning.draws, shift: fewshot.shift, seed: seed ^ EXAMPLES_STREAM };
        self.examples = Some(Examples::filter(&agent, &self.episodes, &views, &core.device)?);
        Ok(())
    }

    fn update_in(&mut self, stage: Stage, number: u64) -> Result<(), TrainingError> {
        let Self { core, world, batches, .. } = self;
        let (seed, update) = (core.settings.seed, core.state.updates);
        let mut sampler = Sampler::numbered(seed, update);
        if stage == Stage::Actor && self.examples.is_some() {
            return self.clone_from_examples(number, &mut sampler);
        }
        let batches = batches.as_mut().expect("entering a stage that draws batches starts them");
        let batch = core.interval.time(TimeBucket::WaitingForBatches, || batches.next_batch())?;
        let told = |losses, gradient_norm| json!({"losses": losses, "gradient_norm": gradient_norm});
        if let (Stage::Actor, WorldUpdates::Tensors { learner, .. }) = (stage, &mut **world) {
            let batch = batch.into_tensors(&core.device)?;
            let update = core.interval.time(TimeBucket::Learning, || learner.update(&batch, &mut sampler))?;
            let examples = Examples::of_batch(&update.posteriors.features()?, &batch)?;
            let losses = told(update.losses, update.gradient_norm);
            return self.clone_from_batch(number, examples, losses, &mut sampler);
        }
        let step = core.interval.time(TimeBucket::Learning, || world.update(batch, seed, update))?;
        core.interval.update(&told(step.losses, step.gradient_norm));
        Ok(())
    }

    fn clone_from_examples(&mut self, number: u64, sampler: &mut Sampler) -> Result<(), TrainingError> {
        let Self { core, cloning, examples, .. } = self;
        let examples = examples.as_ref().expect("the actor's stage begins with them");
        let Core { settings, state, interval, .. } = &mut **core;
        let CloningSettings { rows, imagination_rows: starts, .. } = settings.fewshot.cloning;
        let seed = settings.seed ^ ROWS_STREAM;
        let update = interval.time(TimeBucket::Learning, || {
            let (features, actions) = examples.draw(rows.max(starts), seed, state.updates)?;
            let start = || state_of_features(&features.narrow(0, 0, starts)?, &settings.model);
            let (few, taken) = (features.narrow(0, 0, rows)?, actions.narrow(0, 0, rows)?);
            cloning.update(number, &few, &taken, start, sampler)
        })?;
        interval.update(&json!({"cloning": update}));
        Ok(())
    }

    /// The actor learns from the batch that the world model has just learned from.
    fn clone_from_batch(
        &mut self,
        number: u64,
        (features, actions): (Tensor, Tensor),
        mut values: serde_json::Value,
        sampler: &mut Sampler,
    ) -> Result<(), TrainingError> {
        let Self { core, cloning, .. } = self;
        let Core { settings, interval, .. } = &mut **core;
        let starts = settings.fewshot.cloning.imagination_rows.min(features.dim(0)?);
        let update = interval.time(TimeBucket::Learning, || {
            let start = || state_of_features(&features.narrow(0, 0, starts)?, &settings.model);
            cloning.update(number, &features, &actions, start, sampler)
        })?;
        values["cloning"] = json!(update);
        interval.update(&values);
        Ok(())
    }

    /// How far the actor is from what was done in demonstrations that it does not learn from.
    fn held_out_cloning(&self, agent: &Agent) -> Result<f32, TrainingError> {
        let views = Views { draws: 1, shift: 0, seed: 0 };
        let examples = Examples::filter(agent, &self.held_out, &views, &self.core.device)?;
        let (features, actions) = examples.all();
        let loss = cloning_loss(&agent.actor, features, actions, self.core.settings.fewshot.cloning.loss)?;
        Ok(loss.to_scalar::<f32>()?)
    }
}
