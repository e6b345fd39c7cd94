mod acting;

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use candle_core::Device;
use serde_json::json;

use super::compute::{AgentUpdates, Compute};
use super::evaluations::evaluate;
use super::prefill::{Prefilled, policy_episode, prefill};
use super::update_loop::{Core, Updated, Updates, make_updates};
use super::{EpisodeFacts, EpisodeLine, EvaluationLine, HeldOutLosses, Line, OnlineOutcome, OnlineProgress};
use super::{Interval, Phase, TimeBucket, TrainingError, TrainingSettings, TrainingState, start_from};
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
    core: Core,
    folder: PathBuf,
    updates: AgentUpdates,
    batches: Option<Prefetch>,
    /// Updates that the weights which act have seen.
    acting_since: u64,
    newest: VecDeque<bool>,
    refused_actions: u64,
    /// Evaluations that are behind it.
    evaluations: u64,
}

impl Finetuning {
    /// A new run in `folder`, from a model or from scratch.
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        source: Option<&Checkpoint>,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        if source.is_some_and(|source| source.settings.model != settings.model) {
            settings.validate()?;
            return Err(TrainingError::OtherModel);
        }
        let compute = compute.into();
        let begin = |settings: &TrainingSettings, device: &Device| begin(settings, source, device);
        let core = Core::create(folder, settings, compute.device(), begin)?;
        Self::of(folder, core, compute)
    }

    fn of(folder: &Path, core: Core, compute: Compute) -> Result<Self, TrainingError> {
        let (settings, state) = (&core.settings, &core.state);
        // That of a checkpoint's own step was made before it.
        let evaluations = match state.policy_steps {
            0 => 0,
            steps => settings.finetune.evaluation.due(steps),
        };
        Ok(Self {
            folder: folder.to_path_buf(),
            updates: AgentUpdates::new(compute, settings, &core.parameters)?,
            batches: None,
            acting_since: state.updates,
            newest: VecDeque::new(),
            refused_actions: 0,
            evaluations,
            core,
        })
    }

    /// Goes on with the run in `folder` from its newest checkpoint, or from the beginning if there is none yet.
    pub fn resume(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        let begin = |settings: &TrainingSettings, device: &Device| {
            let source = match settings.phase {
                Phase::Finetune => Some(Checkpoint::read(&settings.from, device)?),
                _ => None,
            };
            begin(settings, source.as_ref(), device)
        };
        let phases = [Phase::Finetune, Phase::Train];
        let (core, moments) = Core::resume(folder, settings, compute.device(), &phases, begin)?;
        let mut this = Self::of(folder, core, compute)?;
        let (core, TrainingSettings { world, behaviour, .. }) = (&this.core, &this.core.settings);
        let of = [&world.adam, &behaviour.actor, &behaviour.critic];
        let adams =
            OPTIMISERS.into_iter().zip(of).map(|(name, settings)| core.adam(name, settings, &moments));
        let adams: Vec<_> = adams.collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect();
        if let Ok(adams) = <[_; 3]>::try_from(adams) {
            this.updates.resume(adams, this.core.state.return_range)?;
        }
        Ok(this)
    }

    /// What has been done so far.
    #[must_use]
    pub fn state(&self) -> &TrainingState {
        &self.core.state
    }

    /// The parameters, as they are.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.core.parameters
    }

    /// Fills the replay, see [`prefill`].
    pub fn prefill(
        &mut self,
        stop: &AtomicBool,
        progress: &(dyn Fn(Progress) + Sync),
    ) -> Result<Prefilled, TrainingError> {
        prefill(&self.folder, &self.core.settings, stop, progress)
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
        let most = self.core.settings.finetune.success_episodes;
        self.newest = filled.policy_successes.iter().rev().take(most).rev().copied().collect();
        self.core.scenes = self.core.settings.film.scenes(&filled.replay);
        let mut replay = filled.replay;
        replay.look(&self.core.settings.replay.look);
        let replay = SharedReplay::new(replay);
        self.batches = Some(self.prefetch(&replay)?);
        self.core.interval = Interval::begin();
        let done = self.work(&replay, join, stop, &mut show);
        self.batches = None;
        // What ended the work says more than what fails after it.
        if let Err(error) = self.write_back() {
            return Err(done.err().unwrap_or(error));
        }
        // Whatever happened: a model with a number that is not finite is never saved.
        check_finite(&self.core.parameters)?;
        self.save()?;
        done?;
        Ok(OnlineOutcome {
            updates: self.core.state.updates,
            policy_steps: self.core.state.policy_steps,
            episodes: self.core.state.episodes,
            success_rate: self.success_rate(),
            refused_actions: self.refused_actions,
            interrupted: self.core.state.policy_steps < self.core.settings.finetune.steps,
        })
    }

    fn work(
        &mut self,
        replay: &SharedReplay,
        join: &[String],
        stop: &AtomicBool,
        show: &mut impl FnMut(&OnlineProgress<'_>),
    ) -> Result<(), TrainingError> {
        self.learn(stop, show)?; // the warm-up
        let steps = self.core.settings.finetune.steps;
        if stop.load(Ordering::Relaxed) || self.core.state.policy_steps >= steps {
            return Ok(());
        }
        self.evaluate(stop, show)?;
        let mut fleet = Fleet::new(&self.launches(), join)?;
        let agent = Agent::new(&self.core.parameters.frozen(), &self.core.settings.model)?;
        let mut policy = Policy::new(agent, fleet.len(), &self.core.device);
        while self.core.state.policy_steps < steps && !stop.load(Ordering::Relaxed) {
            let gathered =
                self.core.interval.time(TimeBucket::WaitingForSimulators, || fleet.gather(stop))?;
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
            self.core.interval.add(TimeBucket::Acting, begin.elapsed());
            drop(gathered);
            self.learn(stop, show)?;
            self.evaluate(stop, show)?;
        }
        Ok(())
    }

    /// Makes the updates that are due.
    fn learn(
        &mut self,
        stop: &AtomicBool,
        show: &mut impl FnMut(&OnlineProgress<'_>),
    ) -> Result<(), TrainingError> {
        let sizes = &self.core.settings.replay;
        let due =
            self.core.settings.finetune.updates_due(self.core.state.policy_steps, sizes.batch * sizes.length);
        make_updates(self, due, stop, &mut |phase, progress| {
            show(&OnlineProgress { line: progress.line, ..phase.progress() });
        })?;
        // The policy acts next.
        let since = self.core.state.updates.saturating_sub(self.acting_since);
        if since >= self.core.settings.finetune.acting_weights_every || self.core.state.policy_steps == 0 {
            self.write_back()?;
        }
        Ok(())
    }

    fn write_back(&mut self) -> Result<(), TrainingError> {
        self.acting_since = self.core.state.updates;
        self.updates.write_back(&self.core.parameters)
    }

    fn prefetch(&self, replay: &SharedReplay) -> Result<Prefetch, TrainingError> {
        let (sizes, replay) = (self.core.settings.replay.clone(), replay.clone());
        let (seed, masks) = (self.core.settings.seed ^ REPLAY_STREAM, self.core.settings.finetune.masks);
        Ok(Prefetch::start(self.core.state.updates, sizes.prefetch, move |number| {
            replay.draw(sizes.batch, sizes.length, masks, seed, number)
        })?)
    }

    fn success_rate(&self) -> Option<f64> {
        let count = self.newest.iter().filter(|success| **success).count();
        (!self.newest.is_empty()).then(|| count as f64 / self.newest.len() as f64)
    }

    fn progress(&self) -> OnlineProgress<'static> {
        OnlineProgress {
            updates: self.core.state.updates,
            policy_steps: self.core.state.policy_steps,
            line: None,
            evaluation: None,
            episode: None,
            success_rate: self.success_rate(),
        }
    }
}

/// Name of the stage in which the policy acts.
const ONLINE: &str = "online";

/// What such a run starts from.
fn begin(
    settings: &TrainingSettings,
    source: Option<&Checkpoint>,
    device: &Device,
) -> Result<Parameters, TrainingError> {
    match source {
        Some(source) => Ok(start_from(source, &settings.reset, settings.seed, device)?),
        None => Ok(agent::initialise(&settings.model, settings.seed, device)?),
    }
}

impl Updates for Finetuning {
    fn core(&mut self) -> &mut Core {
        &mut self.core
    }

    fn update(&mut self) -> Result<Updated, TrainingError> {
        let Self { core: Core { settings, state, interval, .. }, batches, updates, .. } = self;
        let batches = batches.as_mut().expect("a run that goes on has them");
        let batch = interval.time(TimeBucket::WaitingForBatches, || batches.next_batch())?;
        let warm_up = state.updates < settings.finetune.warm_up_updates;
        let numbered = (settings.seed, state.updates);
        let (world, behaviour) =
            interval.time(TimeBucket::Learning, || updates.update(batch, numbered, !warm_up))?;
        let mut values = json!({"losses": world.losses, "gradient_norm": world.gradient_norm});
        if let Some(behaviour) = behaviour {
            values["behaviour"] = json!(behaviour);
        }
        interval.update(&values);
        Ok((if warm_up { "warm_up" } else { ONLINE }, None))
    }

    /// It is the best if the newest episodes had the highest success rate of all checkpoints, the first of equals.
    fn save(&mut self) -> Result<Option<HeldOutLosses>, TrainingError> {
        self.write_back()?;
        let full = self.newest.len() == self.core.settings.finetune.success_episodes;
        let success = self.success_rate().filter(|_| full);
        let Self { core, updates, .. } = self;
        core.state.return_range = updates.return_range();
        let is_best = success.is_some_and(|rate| core.state.best_success.is_none_or(|best| rate > best));
        if is_best {
            core.state.best_success = success;
        }
        let adams = updates.adams(&core.parameters)?;
        let optimisers: Vec<_> = OPTIMISERS.into_iter().zip(&adams).collect();
        let agent = core.agent()?;
        core.write(&agent, &optimisers, is_best.into(), core.settings.finetune.warm_up_updates)?;
        Ok(None)
    }

    fn tell(&mut self, line: &mut Line) {
        line.set("policy_steps", self.core.state.policy_steps as f64);
        line.set("environment_steps", (ACTION_REPEAT * self.core.state.policy_steps) as f64);
        line.set("refused_actions", self.refused_actions as f64);
        self.success_rate().into_iter().for_each(|rate| line.set("success_rate", rate));
    }
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
