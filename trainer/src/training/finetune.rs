mod acting;

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use candle_core::Device;
use serde_json::json;

use super::compute::{AgentUpdates, Compute};
use super::evaluations::evaluate;
use super::film::{Scene, write_films};
use super::prefill::{Prefilled, policy_episode, prefill};
use super::run::Resume;
use super::{EpisodeFacts, EpisodeLine, EvaluationLine, OnlineOutcome, OnlineProgress};
use super::{Interval, Phase, Run, TimeBucket, TrainingError, TrainingSettings, TrainingState, start_from};
use crate::acting::{Fleet, Gathered, Policy, Recorded};
use crate::checkpoint::Checkpoint;
use crate::model::agent::{self, Agent};
use crate::model::latent::Sampler;
use crate::model::parameters::{ParameterError, Parameters};
use crate::replay::{Prefetch, SharedReplay};
use crate::simulators::{Launch, Progress, Script};

/// Names of the optimisers in checkpoints.
const OPTIMISERS: [&str; 3] = ["world", "actor", "critic"];
/// What sets the streams of draws apart under one seed.
const REPLAY_STREAM: u64 = 0x7265_706c_6179;
const ACTING_STREAM: u64 = 0x0061_6374_696e;
/// Numbers of the policy's episodes, and with them their layouts, begin behind those of the scripts; each simulator has its own.
const FIRST_EPISODE: u64 = Script::END;
const EPISODES_A_SIMULATOR: u64 = 1_000_000;
/// How long a separate episode may take before the simulators that wait for its end give up.
const EVALUATED_EPISODE_MAX: Duration = Duration::from_secs(60);
/// Steps of the environment in one decision of the policy.
const ACTION_REPEAT: u64 = 2;

/// Acting and learning on one task: see [`super::FinetuneSettings`]. Fine-tuning and training from scratch differ in what they start
/// from only.
///
/// Simulators compute while the model learns: the policy answers all of them, and then as many updates are made as the train ratio
/// says are due. A resumed run has its weights, optimisers, counters and replay back; the simulators begin new episodes, and steps
/// since the checkpoint count as not made, although their whole episodes are replayed.
#[derive(Debug)]
pub struct Finetuning {
    settings: TrainingSettings,
    device: Device,
    folder: PathBuf,
    run: Run,
    parameters: Parameters,
    updates: AgentUpdates,
    /// Updates that the weights which act have seen.
    acting_since: u64,
    state: TrainingState,
    newest: VecDeque<bool>,
    refused_actions: u64,
    /// Evaluations that are behind it.
    evaluations: u64,
    scenes: Vec<Scene>,
}

impl Finetuning {
    /// A new run in `folder`, from a model or from scratch.
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        source: Option<&Checkpoint>,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        settings.validate()?;
        if source.is_some_and(|source| source.settings.model != settings.model) {
            return Err(TrainingError::OtherModel);
        }
        let run = Run::create(folder, &settings)?;
        Self::fresh(folder, run, settings, source, compute.into())
    }

    fn fresh(
        folder: &Path,
        run: Run,
        settings: TrainingSettings,
        source: Option<&Checkpoint>,
        compute: Compute,
    ) -> Result<Self, TrainingError> {
        let device = compute.device();
        let parameters = match source {
            Some(source) => start_from(source, &settings.reset, settings.seed, &device)?,
            None => agent::initialise(&settings.model, settings.seed, &device)?,
        };
        Self::of(folder, run, settings, parameters, TrainingState::default(), compute)
    }

    fn of(
        folder: &Path,
        run: Run,
        settings: TrainingSettings,
        parameters: Parameters,
        state: TrainingState,
        compute: Compute,
    ) -> Result<Self, TrainingError> {
        let device = compute.device();
        let updates = AgentUpdates::new(compute, &settings, &parameters)?;
        Ok(Self {
            device,
            folder: folder.to_path_buf(),
            run,
            parameters,
            updates,
            acting_since: state.updates,
            // That of a checkpoint's own step was made before it.
            evaluations: if state.policy_steps > 0 {
                settings.finetune.evaluation.due(state.policy_steps)
            } else {
                0
            },
            settings,
            state,
            newest: VecDeque::new(),
            refused_actions: 0,
            scenes: Vec::new(),
        })
    }

    /// Goes on with the run in `folder` from its newest checkpoint, or from the beginning if there is none yet.
    pub fn resume(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        let device = compute.device();
        let phases = [Phase::Finetune, Phase::Train];
        let (run, parameters, state, moments) = match Run::go_on(folder, &settings, &phases, &device)? {
            Resume::FromStart(run) => {
                let source = match settings.phase {
                    Phase::Finetune => Some(Checkpoint::read(&settings.from, &device)?),
                    _ => None,
                };
                return Self::fresh(folder, run, settings, source.as_ref(), compute);
            }
            Resume::From { run, parameters, state, moments } => (run, parameters, state, moments),
        };
        let mut this = Self::of(folder, run, settings, parameters, state, compute)?;
        let adam = |name: &str, settings| this.state.optimiser(name, settings, &moments, &this.parameters);
        let [world, actor, critic] = OPTIMISERS;
        let world = adam(world, &this.settings.world.adam)?;
        let actor = adam(actor, &this.settings.behaviour.actor)?;
        let critic = adam(critic, &this.settings.behaviour.critic)?;
        let range = this.state.return_range;
        this.updates.resume([world, actor, critic], range)?;
        Ok(this)
    }

    /// What has been done so far.
    #[must_use]
    pub fn state(&self) -> &TrainingState {
        &self.state
    }

    /// The parameters, as they are.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Fills the replay, see [`prefill`].
    pub fn prefill(
        &mut self,
        stop: &AtomicBool,
        progress: &(dyn Fn(Progress) + Sync),
    ) -> Result<Prefilled, TrainingError> {
        prefill(&self.folder, &self.settings, stop, progress)
    }

    /// Acts and learns until all steps are made, every simulator has ended, or `stop` is set; any way ends with a checkpoint.
    ///
    /// # Errors
    /// See [`TrainingError`]; the newest checkpoint is then the last good one.
    pub fn run(
        &mut self,
        filled: Prefilled,
        join: &[String],
        stop: &AtomicBool,
        mut show: impl FnMut(&OnlineProgress<'_>),
    ) -> Result<OnlineOutcome, TrainingError> {
        let most = self.settings.finetune.success_episodes;
        self.newest = filled.policy_successes.iter().rev().take(most).rev().copied().collect();
        self.scenes = self.settings.film.scenes(&filled.replay);
        let mut replay = filled.replay;
        replay.look(&self.settings.replay.look);
        let replay = SharedReplay::new(replay);
        let mut learning = Learning { batches: self.prefetch(&replay)?, interval: Interval::begin() };
        let done = self.work(&replay, &mut learning, join, stop, &mut show);
        // What ended the work says more than what fails after it.
        if let Err(error) = self.write_back() {
            return Err(done.err().unwrap_or(error));
        }
        // Whatever happened: a model with a number that is not finite is never saved.
        check_finite(&self.parameters)?;
        self.save()?;
        done?;
        Ok(OnlineOutcome {
            updates: self.state.updates,
            policy_steps: self.state.policy_steps,
            episodes: self.state.episodes,
            success_rate: self.success_rate(),
            refused_actions: self.refused_actions,
            interrupted: self.state.policy_steps < self.settings.finetune.steps,
        })
    }

    fn work(
        &mut self,
        replay: &SharedReplay,
        learning: &mut Learning,
        join: &[String],
        stop: &AtomicBool,
        show: &mut impl FnMut(&OnlineProgress<'_>),
    ) -> Result<(), TrainingError> {
        self.learn(learning, stop, show)?; // the warm-up
        let steps = self.settings.finetune.steps;
        if stop.load(Ordering::Relaxed) || self.state.policy_steps >= steps {
            return Ok(());
        }
        self.evaluate(learning, stop, show)?;
        let mut fleet = Fleet::new(&self.launches(), join)?;
        let agent = Agent::new(&self.parameters.frozen(), &self.settings.model)?;
        let mut policy = Policy::new(agent, fleet.len(), &self.device);
        while self.state.policy_steps < steps && !stop.load(Ordering::Relaxed) {
            let gathered = learning.interval.time(TimeBucket::WaitingForSimulators, || fleet.gather(stop))?;
            if gathered.is_empty() {
                break;
            }
            let begin = std::time::Instant::now();
            self.act(&gathered, &mut fleet, &mut policy)?;
            for one in &gathered {
                if let Some(recorded) = fleet.record(one)? {
                    self.keep(recorded, replay, show)?;
                }
            }
            learning.interval.add(TimeBucket::Acting, begin.elapsed());
            drop(gathered);
            self.learn(learning, stop, show)?;
            self.evaluate(learning, stop, show)?;
        }
        Ok(())
    }

    /// Makes the updates that are due.
    fn learn(
        &mut self,
        learning: &mut Learning,
        stop: &AtomicBool,
        show: &mut impl FnMut(&OnlineProgress<'_>),
    ) -> Result<(), TrainingError> {
        let sizes = &self.settings.replay;
        let due = self.settings.finetune.updates_due(self.state.policy_steps, sizes.batch * sizes.length);
        while self.state.updates < due && !stop.load(Ordering::Relaxed) {
            let phase = self.update(learning)?;
            self.state.updates += 1;
            let updates = self.state.updates;
            let mut line = updates
                .is_multiple_of(self.settings.metrics_every)
                .then(|| learning.interval.end(updates, phase));
            if let Some(line) = &mut line {
                line.set("policy_steps", self.state.policy_steps as f64);
                line.set("environment_steps", (ACTION_REPEAT * self.state.policy_steps) as f64);
                line.set("refused_actions", self.refused_actions as f64);
                self.success_rate().into_iter().for_each(|rate| line.set("success_rate", rate));
                self.run.log(line)?;
            }
            if updates.is_multiple_of(self.settings.checkpoint_every) {
                self.save()?;
            }
            show(&OnlineProgress { line: line.as_ref(), ..self.progress() });
        }
        // The policy acts next.
        let since = self.state.updates.saturating_sub(self.acting_since);
        if since >= self.settings.finetune.acting_weights_every || self.state.policy_steps == 0 {
            self.write_back()?;
        }
        Ok(())
    }

    fn update(&mut self, learning: &mut Learning) -> Result<&'static str, TrainingError> {
        let Learning { batches, interval } = learning;
        let number = self.state.updates;
        let batch = interval.time(TimeBucket::WaitingForBatches, || batches.next_batch())?;
        let warm_up = number < self.settings.finetune.warm_up_updates;
        let (world, behaviour) = interval.time(TimeBucket::Learning, || {
            self.updates.update(batch, (self.settings.seed, number), !warm_up)
        })?;
        let mut values = json!({"losses": world.losses, "gradient_norm": world.gradient_norm});
        if let Some(behaviour) = behaviour {
            values["behaviour"] = json!(behaviour);
        }
        interval.update(&values);
        Ok(if warm_up { "warm_up" } else { ONLINE })
    }

    fn write_back(&mut self) -> Result<(), TrainingError> {
        self.acting_since = self.state.updates;
        self.updates.write_back(&self.parameters)
    }

    fn prefetch(&self, replay: &SharedReplay) -> Result<Prefetch, TrainingError> {
        let (sizes, replay) = (self.settings.replay.clone(), replay.clone());
        let (seed, masks) = (self.settings.seed ^ REPLAY_STREAM, self.settings.finetune.masks);
        Ok(Prefetch::start(self.state.updates, sizes.prefetch, move |number| {
            replay.draw(sizes.batch, sizes.length, masks, seed, number)
        })?)
    }

    /// Saves a checkpoint; it is the best if the newest episodes had the highest success rate of all checkpoints, the first of equals.
    fn save(&mut self) -> Result<(), TrainingError> {
        self.write_back()?;
        self.state.return_range = self.updates.return_range();
        let full = self.newest.len() == self.settings.finetune.success_episodes;
        let success = self.success_rate().filter(|_| full);
        let is_best = success.is_some_and(|rate| self.state.best_success.is_none_or(|best| rate > best));
        if is_best {
            self.state.best_success = success;
        }
        let adams = self.updates.adams(&self.parameters)?;
        let optimisers: Vec<_> = OPTIMISERS.into_iter().zip(&adams).collect();
        self.run.save(&self.parameters, &self.settings, &self.state, &optimisers, is_best.into())?;
        self.run.draw_curves(self.settings.finetune.warm_up_updates)?;
        let agent = Agent::new(&self.parameters.frozen(), &self.settings.model)?;
        let (film, update) = (&self.settings.film, self.state.updates);
        write_films(&self.run, &agent, &self.scenes, film, update, &self.device)
    }

    fn success_rate(&self) -> Option<f64> {
        let count = self.newest.iter().filter(|success| **success).count();
        (!self.newest.is_empty()).then(|| count as f64 / self.newest.len() as f64)
    }

    fn progress(&self) -> OnlineProgress<'static> {
        OnlineProgress {
            updates: self.state.updates,
            policy_steps: self.state.policy_steps,
            line: None,
            evaluation: None,
            episode: None,
            success_rate: self.success_rate(),
        }
    }
}

/// Name of the stage in which the policy acts.
const ONLINE: &str = "online";

/// What updates take from.
struct Learning {
    batches: Prefetch,
    interval: Interval,
}

/// Refuses a model with a number that is not finite.
fn check_finite(parameters: &Parameters) -> Result<(), TrainingError> {
    for (name, var) in parameters.iter() {
        let values = var.flatten_all()?.to_vec1::<f32>()?;
        let count = values.iter().filter(|value| !value.is_finite()).count();
        if count > 0 {
            return Err(ParameterError::NotFinite { name: name.to_owned(), count }.into());
        }
    }
    Ok(())
}
