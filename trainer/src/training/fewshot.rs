use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::{Device, Tensor};
use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelKind;
use serde_json::json;

use super::film::{Scene, write_films};
use super::run::Resume;
use super::{
    Best, FewshotSettings, Interval, Line, Outcome, Phase, Run, TimeBucket, TrainingError, TrainingSettings,
    TrainingState, start_from,
};
use crate::checkpoint::Checkpoint;
use crate::cloning::CloningLearner;
use crate::learning::{
    Examples, Imitation, Side, Trained, Views, WorldLearner, cloning_loss, side_of, state_of_features,
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
    /// The actor.
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
    settings: TrainingSettings,
    device: Device,
    run: Run,
    parameters: Parameters,
    world: WorldLearner,
    cloning: CloningLearner,
    state: TrainingState,
    scenes: Vec<Scene>,
    held_out: Vec<Arc<Episode>>,
}

impl Fewshot {
    /// A new run in `folder`, from a pre-trained model.
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        source: &Checkpoint,
        device: &Device,
    ) -> Result<Self, TrainingError> {
        settings.validate()?;
        if source.settings.model != settings.model {
            return Err(TrainingError::OtherModel);
        }
        let run = Run::create(folder, &settings)?;
        Self::fresh(run, settings, source, device)
    }

    fn fresh(
        run: Run,
        settings: TrainingSettings,
        source: &Checkpoint,
        device: &Device,
    ) -> Result<Self, TrainingError> {
        let parameters = start_from(source, &settings.reset, settings.seed, device)?;
        Self::of(run, settings, parameters, TrainingState::default(), device)
    }

    fn of(
        run: Run,
        settings: TrainingSettings,
        parameters: Parameters,
        state: TrainingState,
        device: &Device,
    ) -> Result<Self, TrainingError> {
        let model = &settings.model;
        let world = WorldLearner::new(&parameters, model, &settings.world, Trained::World)?;
        let cloning =
            CloningLearner::new(&parameters, model, &settings.fewshot.cloning, &settings.behaviour)?;
        Ok(Self {
            settings,
            device: device.clone(),
            run,
            parameters,
            world,
            cloning,
            state,
            scenes: Vec::new(),
            held_out: Vec::new(),
        })
    }

    /// Goes on with the run in `folder` from its newest checkpoint, or from the beginning if there is none yet.
    pub fn resume(folder: &Path, settings: TrainingSettings, device: &Device) -> Result<Self, TrainingError> {
        let (run, parameters, state, moments) =
            match Run::go_on(folder, &settings, &[Phase::Fewshot], device)? {
                Resume::FromStart(run) => {
                    let source = Checkpoint::read(&settings.from, device)?;
                    return Self::fresh(run, settings, &source, device);
                }
                Resume::From { run, parameters, state, moments } => (run, parameters, state, moments),
            };
        let mut this = Self::of(run, settings, parameters, state, device)?;
        let adam = |name: &str, settings| this.state.optimiser(name, settings, &moments, &this.parameters);
        let [world, actor, critic] = OPTIMISERS;
        *this.world.adam_mut() = adam(world, &this.settings.world.adam)?;
        let actor = adam(actor, &this.settings.fewshot.cloning.actor)?;
        let critic = adam(critic, &this.settings.behaviour.critic)?;
        this.cloning.resume(actor, critic, this.state.return_range);
        Ok(this)
    }

    /// Updates made so far.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.state.updates
    }

    /// The parameters, as they are.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Learns from the demonstrations in `replay` until all updates are made or `stop` is set; either way ends with a checkpoint.
    ///
    /// # Errors
    /// See [`TrainingError`]; the newest checkpoint is then the last good one.
    pub fn run(
        &mut self,
        replay: Replay,
        stop: &AtomicBool,
        mut show: impl FnMut(u64, Option<&Line>),
    ) -> Result<Outcome, TrainingError> {
        let total = self.settings.fewshot.updates();
        let (replay, held_out) = replay.hold_out(self.settings.fewshot.held_out);
        self.scenes = self.settings.film.scenes(if held_out.episodes() > 0 { &held_out } else { &replay });
        let of = |replay: &Replay| replay.tasks().flat_map(|(_, episodes)| episodes).cloned().collect();
        let episodes: Vec<_> = of(&replay);
        self.held_out = of(&held_out);
        let mut work = Work { batches: None, replay, examples: None, stage: None };
        let mut interval = Interval::begin();
        let mut saved_at = None;
        while self.state.updates < total && !stop.load(Ordering::Relaxed) {
            let (stage, number) = Stage::of(&self.settings.fewshot, self.state.updates);
            if work.stage != Some(stage) {
                self.enter(stage, number, &mut work, &episodes)?;
            }
            self.update(stage, number, &mut work, &mut interval)?;
            self.state.updates += 1;
            let updates = self.state.updates;
            self.run.ema_update(&self.parameters, self.moved(stage), updates)?;
            let line = updates
                .is_multiple_of(self.settings.metrics_every)
                .then(|| interval.end(updates, stage.name()));
            if let Some(line) = &line {
                self.run.log(line)?;
            }
            if updates.is_multiple_of(self.settings.checkpoint_every) {
                self.save()?;
                saved_at = Some(updates);
            }
            show(updates, line.as_ref());
        }
        if saved_at != Some(self.state.updates) {
            self.save()?;
        }
        Ok(Outcome { updates: self.state.updates, interrupted: self.state.updates < total })
    }

    /// Which parameters an update of the stage may move.
    fn moved(&self, stage: Stage) -> fn(&str) -> bool {
        match stage {
            Stage::Actor if !self.settings.fewshot.world_goes_on => {
                |name| matches!(side_of(name), Side::Actor | Side::Critic | Side::SlowCritic)
            }
            _ => |_| true,
        }
    }

    /// Prepares what the stage needs from its update `number` on.
    fn enter(
        &mut self,
        stage: Stage,
        number: u64,
        work: &mut Work,
        episodes: &[Arc<Episode>],
    ) -> Result<(), TrainingError> {
        work.stage = Some(stage);
        if stage == Stage::Actor && number == 0 {
            // The actor learns on the states that the deployed world model will give it.
            self.parameters.mix(&self.run.ema_weights(&self.parameters), 1.0, |_| true)?;
        }
        let fewshot = &self.settings.fewshot;
        let imitation = Imitation {
            scale: fewshot.imitation_scale,
            loss: fewshot.cloning.loss,
            learning_rate: self.settings.world.adam.learning_rate,
        };
        let imitation = (stage != Stage::Actor && imitation.scale > 0.0).then_some(imitation);
        self.world.train(stage.trained(self.settings.model.kind, imitation.is_some()), imitation)?;
        let seed = self.settings.seed;
        if stage != Stage::Actor || fewshot.world_goes_on {
            if work.batches.is_none() {
                let (sizes, mut replay) = (self.settings.replay.clone(), work.replay.clone());
                replay.look(&sizes.look);
                let (shift, starts) = (fewshot.shift, fewshot.starts);
                work.batches = Some(Prefetch::start(self.state.updates, sizes.prefetch, move |number| {
                    let seed = seed ^ REPLAY_STREAM;
                    let mut batch =
                        replay.draw_from(starts, sizes.batch, sizes.length, false, seed, number)?;
                    batch.shift(shift, seed, number);
                    Ok(batch)
                })?);
            }
            return Ok(());
        }
        work.batches = None;
        let agent = Agent::new(&self.parameters.frozen(), &self.settings.model)?;
        let views =
            Views { draws: fewshot.cloning.draws, shift: fewshot.shift, seed: seed ^ EXAMPLES_STREAM };
        work.examples = Some(Examples::filter(&agent, episodes, &views, &self.device)?);
        Ok(())
    }

    fn update(
        &mut self,
        stage: Stage,
        number: u64,
        work: &mut Work,
        interval: &mut Interval,
    ) -> Result<(), TrainingError> {
        let mut sampler = Sampler::numbered(self.settings.seed, self.state.updates);
        if let (Stage::Actor, Some(examples)) = (stage, &work.examples) {
            return self.clone_from_examples(number, examples, &mut sampler, interval);
        }
        let batches = work.batches.as_mut().expect("entering a stage that draws batches starts them");
        let batch = interval.time(TimeBucket::WaitingForBatches, || batches.next_batch())?;
        let batch = batch.into_tensors(&self.device)?;
        let update = interval.time(TimeBucket::Learning, || self.world.update(&batch, &mut sampler))?;
        let losses = json!({"losses": update.losses, "gradient_norm": update.gradient_norm});
        if stage == Stage::Actor {
            let examples = Examples::of_batch(&update.posteriors.features()?, &batch)?;
            return self.clone_from_batch(number, examples, losses, &mut sampler, interval);
        }
        interval.update(&losses);
        Ok(())
    }

    fn clone_from_examples(
        &mut self,
        number: u64,
        examples: &Examples,
        sampler: &mut Sampler,
        interval: &mut Interval,
    ) -> Result<(), TrainingError> {
        let settings = &self.settings.fewshot.cloning;
        let (rows, starts) = (settings.rows, settings.imagination_rows);
        let seed = self.settings.seed ^ ROWS_STREAM;
        let update = interval.time(TimeBucket::Learning, || {
            let (features, actions) = examples.draw(rows.max(starts), seed, self.state.updates)?;
            let start = || state_of_features(&features.narrow(0, 0, starts)?, &self.settings.model);
            let (few, taken) = (features.narrow(0, 0, rows)?, actions.narrow(0, 0, rows)?);
            self.cloning.update(number, &few, &taken, start, sampler)
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
        interval: &mut Interval,
    ) -> Result<(), TrainingError> {
        let starts = self.settings.fewshot.cloning.imagination_rows.min(features.dim(0)?);
        let update = interval.time(TimeBucket::Learning, || {
            let start = || state_of_features(&features.narrow(0, 0, starts)?, &self.settings.model);
            self.cloning.update(number, &features, &actions, start, sampler)
        })?;
        values["cloning"] = json!(update);
        interval.update(&values);
        Ok(())
    }

    /// How far the actor is from what was done in demonstrations that it does not learn from.
    fn held_out_cloning(&self, agent: &Agent) -> Result<f32, TrainingError> {
        let views = Views { draws: 1, shift: 0, seed: 0 };
        let examples = Examples::filter(agent, &self.held_out, &views, &self.device)?;
        let (features, actions) = examples.all();
        let loss = cloning_loss(&agent.actor, features, actions, self.settings.fewshot.cloning.loss)?;
        Ok(loss.to_scalar::<f32>()?)
    }

    fn save(&mut self) -> Result<(), TrainingError> {
        self.state.return_range = self.cloning.return_range();
        let [actor, critic] = self.cloning.adams();
        let [world_name, actor_name, critic_name] = OPTIMISERS;
        let optimisers = [(world_name, self.world.adam()), (actor_name, actor), (critic_name, critic)];
        self.run.save(&self.parameters, &self.settings, &self.state, &optimisers, Best::No)?;
        let agent = Agent::new(&self.run.ema_weights(&self.parameters).frozen(), &self.settings.model)?;
        if !self.held_out.is_empty() {
            let cloning = self.held_out_cloning(&agent)?;
            self.run.log(&json!({"update": self.state.updates, "held_out": {"cloning": cloning}}))?;
        }
        self.run.draw_curves(0)?;
        let (film, update) = (&self.settings.film, self.state.updates);
        write_films(&self.run, &agent, &self.scenes, film, update, &self.device)
    }
}

/// What the present stage works on.
struct Work {
    replay: Replay,
    stage: Option<Stage>,
    batches: Option<Prefetch>,
    examples: Option<Examples>,
}
