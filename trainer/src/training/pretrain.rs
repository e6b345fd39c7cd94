use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use candle_core::Device;

use super::compute::{Compute, WorldStep, WorldUpdates};
use super::film::{Scene, write_films};
use super::held_out::{HeldOut, mean_losses};
use super::run::Resume;
use super::{Best, HeldOutLosses, Metrics, Phase, Run, TrainingError, TrainingSettings, TrainingState};
use crate::learning::{LossValues, Trained};
use crate::model::agent::{self, Agent};
use crate::model::parameters::Parameters;
use crate::replay::{Prefetch, Replay};

/// Name of the world model's optimiser in checkpoints.
const WORLD: &str = "world";
/// What sets the replay's stream of draws apart from the sampler's under the same seed.
const REPLAY_STREAM: u64 = 0x7265_706c_6179;

/// Pre-training of the world model: masked warm-up, then mask-free updates.
#[derive(Debug)]
pub struct Pretraining {
    settings: TrainingSettings,
    device: Device,
    run: Run,
    parameters: Parameters,
    learner: WorldUpdates,
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
    /// What the checkpoint gives on the held-out episodes, if one was saved and there are any.
    pub held_out: Option<&'a HeldOutLosses>,
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
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        settings.validate()?;
        let run = Run::create(folder, &settings)?;
        Self::fresh(run, settings, compute.into())
    }

    fn fresh(run: Run, settings: TrainingSettings, compute: Compute) -> Result<Self, TrainingError> {
        let device = compute.device();
        let parameters = agent::initialise(&settings.model, settings.seed, &device)?;
        let learner = WorldUpdates::new(compute, &settings, &parameters, None)?;
        Ok(Self { settings, device, run, parameters, learner, state: TrainingState::default() })
    }

    /// Goes on with the run in `folder` from its newest checkpoint.
    pub fn resume(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        let device = compute.device();
        let (run, parameters, state, moments) =
            match Run::go_on(folder, &settings, &[Phase::Pretrain], &device)? {
                Resume::FromStart(run) => return Self::fresh(run, settings, compute),
                Resume::From { run, parameters, state, moments } => (run, parameters, state, moments),
            };
        let adam = state.optimiser(WORLD, &settings.world.adam, &moments, &parameters)?;
        let learner = WorldUpdates::new(compute, &settings, &parameters, Some(adam))?;
        Ok(Self { settings, device, run, parameters, learner, state })
    }

    /// Updates made so far.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.state.updates
    }

    /// The parameters that are trained, as they are.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// What a checkpoint would hold of them: see [`Run::ema_weights`].
    #[must_use]
    pub fn ema_weights(&self) -> Parameters {
        self.run.ema_weights(&self.parameters)
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
        let (mut replay, mut held_out) = replay.hold_out(self.settings.replay.held_out_episodes);
        self.learner.begin(&self.settings, &self.parameters, &self.run, [&mut replay, &mut held_out])?;
        let validation = Validation::new(&self.settings, &replay, held_out);
        replay.look(&self.settings.replay.look);
        let mut batches = self.prefetch(replay)?;
        let mut interval = Interval::begin(&batches);
        let mut since_checkpoint = Means::default();
        let mut saved_at = None;
        while self.state.updates < self.settings.pretrain.updates && !stop.load(Ordering::Relaxed) {
            let number = self.state.updates;
            let update = self.learner.update(batches.next_batch()?, self.settings.seed, number)?;
            self.state.updates += 1;
            if self.learner.leaves_average() {
                self.run.ema_update(&self.parameters, Trained::World.filter(), self.state.updates)?;
            }
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
            let mut losses = None;
            if saved {
                let begin = Instant::now();
                losses = self.save(std::mem::take(&mut since_checkpoint), &validation)?;
                // Updates a second are those of training.
                interval.begin += begin.elapsed();
                saved_at = Some(self.state.updates);
            }
            let (updates, held_out) = (self.state.updates, losses.as_ref());
            show(&Progress { updates, metrics: metrics.as_ref(), saved, held_out });
        }
        if saved_at != Some(self.state.updates) {
            self.save(since_checkpoint, &validation)?;
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

    /// Saves a checkpoint, then judges it, draws the curves and makes films.
    fn save(
        &mut self,
        since: Means,
        validation: &Validation,
    ) -> Result<Option<HeldOutLosses>, TrainingError> {
        let adam = self.learner.write_back(&self.parameters, &mut self.run)?;
        let agent = Agent::new(&self.run.ema_weights(&self.parameters).frozen(), &self.settings.model)?;
        let (sizes, world) = (&self.settings.replay, &self.settings.world);
        let held_out = validation.held_out.losses(&agent, sizes, world, &self.device, &mut self.learner)?;
        let best = match &held_out {
            Some(losses) => lower(Some(losses.total), &mut self.state.best_held_out_loss),
            None => lower(since.mask_free_loss(), &mut self.state.best_loss),
        };
        let update = self.state.updates;
        let line = held_out.map(|held_out| HeldOutLosses { update, held_out, best: best == Best::Yes });
        // Before the checkpoint: who dies in between loses both, because a resumed run drops lines beyond its checkpoint.
        if let Some(line) = &line {
            self.run.log(line)?;
        }
        let optimisers = [(WORLD, &adam)];
        self.run.save(&self.parameters, &self.settings, &self.state, &optimisers, best)?;
        self.run.draw_curves(self.settings.pretrain.warm_up_updates)?;
        write_films(&self.run, &agent, &validation.scenes, &self.settings.film, update, &self.device)?;
        Ok(line)
    }
}

/// What checkpoints are judged by.
#[derive(Debug)]
struct Validation {
    held_out: HeldOut,
    scenes: Vec<Scene>,
}

impl Validation {
    /// Films are of held-out episodes; of a task without one, of an episode that is trained on.
    fn new(settings: &TrainingSettings, replay: &Replay, held_out: Replay) -> Self {
        let mut scenes = settings.film.scenes(&held_out);
        for (task, episode) in settings.film.scenes(replay) {
            if scenes.iter().all(|(other, _)| *other != task) {
                scenes.push((task, episode));
            }
        }
        Self { held_out: HeldOut::new(held_out, settings.seed), scenes }
    }
}

/// Whether `loss` is lower than the lowest so far, which then follows.
fn lower(loss: Option<f64>, lowest: &mut Option<f64>) -> Best {
    match (loss, *lowest) {
        (None, _) => Best::No,
        (Some(loss), Some(before)) if loss >= before => Best::No,
        (Some(_), _) => {
            *lowest = loss;
            Best::Yes
        }
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
    fn add(&mut self, update: &WorldStep) {
        self.losses.push((update.losses, update.gradient_norm));
    }

    /// Mean of the total loss over updates without masks.
    fn mask_free_loss(&self) -> Option<f64> {
        let mask_free = self.losses.iter().filter(|(losses, _)| losses.robot_mask.is_none());
        let totals: Vec<f64> = mask_free.map(|(losses, _)| losses.total).collect();
        (!totals.is_empty()).then(|| totals.iter().sum::<f64>() / totals.len() as f64)
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
        let losses: Vec<LossValues> = self.means.losses.iter().map(|(losses, _)| *losses).collect();
        Metrics {
            update,
            phase,
            losses: mean_losses(&losses),
            gradient_norm: self.means.losses.iter().map(|(_, norm)| norm).sum::<f64>() / count.max(1.0),
            updates_per_second: count / seconds,
            waiting_share: (batches.waited().as_secs_f64() - self.waited_before_s) / seconds,
        }
    }
}
