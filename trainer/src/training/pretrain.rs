use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use candle_core::Device;
use rcwm_models::episode::Episode;

use super::{Metrics, Run, TrainingError, TrainingSettings, TrainingState, film_strip, write_png};
use crate::learning::{LossValues, Trained, WorldLearner, WorldUpdate};
use crate::model::agent::{self, Agent};
use crate::model::latent::Sampler;
use crate::model::parameters::Parameters;
use crate::replay::{Prefetch, Replay};

/// Name of the world model's optimiser in checkpoints.
const WORLD: &str = "world";
/// What sets the replay's stream of draws apart from the sampler's under the same seed.
const REPLAY_STREAM: u64 = 0x7265_706c_6179;

/// A task and an episode of it to make films of.
type Scene = (String, Arc<Episode>);

/// Pre-training of the world model (spec: phases 2): masked warm-up, then mask-free updates.
#[derive(Debug)]
pub struct Pretraining {
    settings: TrainingSettings,
    device: Device,
    run: Run,
    parameters: Parameters,
    learner: WorldLearner,
    state: TrainingState,
}

/// Where a run stands, for whoever shows it.
#[derive(Debug, Clone)]
pub struct Progress<'a> {
    /// Updates made.
    pub updates: u64,
    /// The newest line of metrics, when there is a new one.
    pub metrics: Option<&'a Metrics>,
    /// Whether a checkpoint was just saved.
    pub saved: bool,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outcome {
    /// Updates made in all.
    pub updates: u64,
    /// Whether it was stopped before its end; it can be resumed.
    pub interrupted: bool,
}

impl Pretraining {
    /// A new run in `folder`.
    ///
    /// # Errors
    /// See [`TrainingError`].
    pub fn create(folder: &Path, settings: TrainingSettings, device: &Device) -> Result<Self, TrainingError> {
        settings.validate()?;
        let run = Run::create(folder, &settings)?;
        Self::fresh(run, settings, device)
    }

    fn fresh(run: Run, settings: TrainingSettings, device: &Device) -> Result<Self, TrainingError> {
        let parameters = agent::initialise(&settings.model, settings.seed, device)?;
        let learner = WorldLearner::new(&parameters, &settings.model, &settings.world, Trained::World)?;
        Ok(Self {
            settings,
            device: device.clone(),
            run,
            parameters,
            learner,
            state: TrainingState::default(),
        })
    }

    /// Goes on with the run in `folder` from its newest checkpoint.
    ///
    /// # Errors
    /// See [`TrainingError`].
    pub fn resume(folder: &Path, settings: TrainingSettings, device: &Device) -> Result<Self, TrainingError> {
        settings.validate()?;
        if !Run::has_checkpoint(folder) {
            return Self::fresh(Run::resume(folder, &settings, 0)?, settings, device);
        }
        let (checkpoint, state, moments) = Run::load(folder, device)?;
        if checkpoint.settings.model != settings.model {
            return Err(TrainingError::OtherModel);
        }
        let parameters = checkpoint.parameters;
        let mut learner = WorldLearner::new(&parameters, &settings.model, &settings.world, Trained::World)?;
        *learner.adam_mut() = state.optimiser(WORLD, &settings.world.adam, &moments, &parameters)?;
        let run = Run::resume(folder, &settings, state.updates)?;
        Ok(Self { settings, device: device.clone(), run, parameters, learner, state })
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

    /// Trains until the settings' number of updates is reached or `stop` is set; either way ends with a checkpoint.
    ///
    /// # Errors
    /// See [`TrainingError`]; the newest checkpoint is then the last good one.
    pub fn run(
        &mut self,
        replay: Replay,
        stop: &AtomicBool,
        mut show: impl FnMut(&Progress<'_>),
    ) -> Result<Outcome, TrainingError> {
        let scenes = self.scenes(&replay);
        let mut batches = self.prefetch(replay)?;
        let mut interval = Interval::begin(&batches);
        let mut since_checkpoint = Means::default();
        let mut saved_at = None;
        while self.state.updates < self.settings.pretrain.updates && !stop.load(Ordering::Relaxed) {
            let number = self.state.updates;
            let batch = batches.next_batch()?.into_tensors(&self.device)?;
            let update = self.learner.update(&batch, &mut Sampler::numbered(self.settings.seed, number))?;
            self.state.updates += 1;
            interval.means.add(&update);
            since_checkpoint.add(&update);
            let metrics = self.state.updates.is_multiple_of(self.settings.metrics_every).then(|| {
                let done = std::mem::replace(&mut interval, Interval::begin(&batches));
                done.metrics(self.state.updates, phase(&self.settings, number), &batches)
            });
            if let Some(metrics) = &metrics {
                self.run.log(metrics)?;
            }
            let saved = self.state.updates.is_multiple_of(self.settings.checkpoint_every);
            if saved {
                self.save(std::mem::take(&mut since_checkpoint), &scenes)?;
                saved_at = Some(self.state.updates);
            }
            show(&Progress { updates: self.state.updates, metrics: metrics.as_ref(), saved });
        }
        if saved_at != Some(self.state.updates) {
            self.save(since_checkpoint, &scenes)?;
        }
        let interrupted = self.state.updates < self.settings.pretrain.updates;
        Ok(Outcome { updates: self.state.updates, interrupted })
    }

    fn prefetch(&self, replay: Replay) -> Result<Prefetch, TrainingError> {
        let (sizes, warm_up) = (self.settings.replay.clone(), self.settings.pretrain.warm_up_updates);
        let seed = self.settings.seed ^ REPLAY_STREAM;
        let masked = replay.masked();
        Ok(Prefetch::start(self.state.updates, sizes.prefetch, move |number| {
            let masks = number < warm_up;
            let source = if masks { &masked } else { &replay };
            source.draw(sizes.batch, sizes.length, masks, seed, number)
        })?)
    }

    /// Saves a checkpoint; it is the best if the mask-free updates since the last one had the lowest mean loss so far.
    fn save(&mut self, since: Means, scenes: &[Scene]) -> Result<(), TrainingError> {
        let loss = since.mask_free_loss();
        let is_best = match (loss, self.state.best_loss) {
            (Some(loss), Some(best)) => loss < best,
            (loss, None) => loss.is_some(),
            (None, Some(_)) => false,
        };
        if is_best {
            self.state.best_loss = loss;
        }
        let optimisers = [(WORLD, self.learner.adam())];
        self.run.save(&self.parameters, &self.settings, &self.state, &optimisers, is_best)?;
        let agent = Agent::new(&self.parameters.frozen(), &self.settings.model)?;
        for (task, episode) in scenes {
            let strip = film_strip(&agent, episode, &self.settings.film, &self.device)?;
            write_png(&strip, &self.run.film(self.state.updates, task)?)?;
        }
        Ok(())
    }

    /// The first episode of every task that is long enough to imagine some of.
    fn scenes(&self, replay: &Replay) -> Vec<Scene> {
        let film = &self.settings.film;
        let long = |episode: &&Arc<Episode>| film.length > 0 && episode.len() > film.context;
        let first = |(task, episodes): (&str, Vec<&Arc<Episode>>)| {
            let episode = episodes.into_iter().find(long)?;
            Some((task.to_owned(), Arc::clone(episode)))
        };
        replay.tasks().filter_map(first).collect()
    }
}

fn phase(settings: &TrainingSettings, number: u64) -> &'static str {
    if number < settings.pretrain.warm_up_updates { "warm_up" } else { "mask_free" }
}

/// Sums of what updates said.
#[derive(Debug, Default)]
struct Means {
    losses: Vec<(LossValues, f64)>,
}

impl Means {
    fn add(&mut self, update: &WorldUpdate) {
        self.losses.push((update.losses, update.gradient_norm));
    }

    fn mean(&self, value: impl Fn(&LossValues) -> Option<f64>) -> Option<f64> {
        let values: Vec<f64> = self.losses.iter().filter_map(|(losses, _)| value(losses)).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    }

    /// Mean of the total loss over updates without masks.
    fn mask_free_loss(&self) -> Option<f64> {
        self.mean(|losses| losses.robot_mask.is_none().then_some(losses.total))
    }
}

/// The time between two lines of metrics.
#[derive(Debug)]
struct Interval {
    begin: Instant,
    waited_before_s: f64,
    means: Means,
}

impl Interval {
    fn begin(batches: &Prefetch) -> Self {
        let waited_before_s = batches.waited().as_secs_f64();
        Self { begin: Instant::now(), waited_before_s, means: Means::default() }
    }

    fn metrics(self, update: u64, phase: &'static str, batches: &Prefetch) -> Metrics {
        let seconds = self.begin.elapsed().as_secs_f64().max(1e-9);
        let count = self.means.losses.len() as f64;
        let mean =
            |value: fn(&LossValues) -> f64| self.means.mean(|losses| Some(value(losses))).unwrap_or_default();
        Metrics {
            update,
            phase,
            losses: LossValues {
                total: mean(|losses| losses.total),
                image: mean(|losses| losses.image),
                robot_mask: self.means.mean(|losses| losses.robot_mask),
                reward: mean(|losses| losses.reward),
                continues: mean(|losses| losses.continues),
                robot_kl: mean(|losses| losses.robot_kl),
                environment_kl: self.means.mean(|losses| losses.environment_kl),
            },
            gradient_norm: self.means.losses.iter().map(|(_, norm)| norm).sum::<f64>() / count.max(1.0),
            updates_per_second: count / seconds,
            waiting_share: (batches.waited().as_secs_f64() - self.waited_before_s) / seconds,
        }
    }
}
