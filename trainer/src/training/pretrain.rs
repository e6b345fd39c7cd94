use std::path::Path;
use std::sync::atomic::AtomicBool;

use candle_core::Device;
use serde_json::json;

use super::compute::{Compute, WorldUpdates};
use super::film::Scene;
use super::held_out::HeldOut;
use super::update_loop::{Core, Outcome, Progress, Updated, Updates, make_all_updates};
use super::{Best, HeldOutLosses, Phase, TimeBucket, TrainingError, TrainingSettings};
use crate::learning::Trained;
use crate::model::agent;
use crate::model::parameters::Parameters;
use crate::replay::{Prefetch, Replay};

/// Name of the world model's optimiser in checkpoints.
const WORLD: &str = "world";
/// What sets the replay's stream of draws apart from the sampler's under the same seed.
const REPLAY_STREAM: u64 = 0x7265_706c_6179;

/// Pre-training of the world model: masked warm-up, then mask-free updates.
#[derive(Debug)]
pub struct Pretraining {
    core: Core,
    learner: WorldUpdates,
}

fn begin(settings: &TrainingSettings, device: &Device) -> Result<Parameters, TrainingError> {
    Ok(agent::initialise(&settings.model, settings.seed, device)?)
}

impl Pretraining {
    /// A new run in `folder`.
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        let core = Core::create(folder, settings, compute.device(), begin)?;
        let learner = WorldUpdates::new(compute, &core.settings, &core.parameters, None)?;
        Ok(Self { core, learner })
    }

    /// Goes on with the run in `folder` from its newest checkpoint, or from the beginning if there is none yet.
    pub fn resume(
        folder: &Path,
        settings: TrainingSettings,
        compute: impl Into<Compute>,
    ) -> Result<Self, TrainingError> {
        let compute = compute.into();
        let (core, moments) = Core::resume(folder, settings, compute.device(), &[Phase::Pretrain], begin)?;
        let adam = core.adam(WORLD, &core.settings.world.adam, &moments)?;
        let learner = WorldUpdates::new(compute, &core.settings, &core.parameters, adam)?;
        Ok(Self { core, learner })
    }

    /// Updates made so far.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.core.state.updates
    }

    /// The parameters that are trained, as they are.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.core.parameters
    }

    /// What a checkpoint would hold of them: see [`super::Run::ema_weights`].
    #[must_use]
    pub fn ema_weights(&self) -> Parameters {
        self.core.run.ema_weights(&self.core.parameters)
    }

    /// Trains until the settings' number of updates is reached or `stop` is set; either way ends with a checkpoint.
    ///
    /// # Errors
    /// See [`TrainingError`]; the newest checkpoint is then the last good one.
    pub fn run(
        &mut self,
        replay: Replay,
        stop: &AtomicBool,
        show: impl FnMut(&Progress<'_>),
    ) -> Result<Outcome, TrainingError> {
        let Self { core, learner } = self;
        let settings = &core.settings;
        let (mut replay, mut held_out) = replay.hold_out(settings.replay.held_out_episodes);
        learner.begin(settings, &core.parameters, &core.run, [&mut replay, &mut held_out])?;
        core.scenes = scenes(settings, &replay, &held_out);
        let held_out = HeldOut::new(held_out, settings.seed);
        replay.look(&settings.replay.look);
        let batches = prefetch(settings, replay, core.state.updates)?;
        let until = settings.pretrain.updates;
        let mask_free = MaskFree::default();
        make_all_updates(&mut Running { core, learner, batches, held_out, mask_free }, until, stop, show)
    }
}

/// Films are of held-out episodes; of a task without one, of an episode that is trained on.
fn scenes(settings: &TrainingSettings, replay: &Replay, held_out: &Replay) -> Vec<Scene> {
    let mut scenes = settings.film.scenes(held_out);
    for (task, episode) in settings.film.scenes(replay) {
        if scenes.iter().all(|(other, _)| *other != task) {
            scenes.push((task, episode));
        }
    }
    scenes
}

fn prefetch(settings: &TrainingSettings, replay: Replay, updates: u64) -> Result<Prefetch, TrainingError> {
    let (sizes, warm_up) = (settings.replay.clone(), settings.pretrain.warm_up_updates);
    let seed = settings.seed ^ REPLAY_STREAM;
    let masked = replay.masked();
    Ok(Prefetch::start(updates, sizes.prefetch, move |number| {
        let masks = number < warm_up;
        let source = if masks { &masked } else { &replay };
        source.draw(sizes.batch, sizes.length, masks, seed, number)
    })?)
}

/// Total losses of the updates without masks since the last checkpoint.
#[derive(Debug, Default)]
struct MaskFree {
    sum: f64,
    count: u32,
}

impl MaskFree {
    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / f64::from(self.count))
    }
}

/// Pre-training under way.
struct Running<'a> {
    core: &'a mut Core,
    learner: &'a mut WorldUpdates,
    batches: Prefetch,
    /// What checkpoints are judged by.
    held_out: HeldOut,
    mask_free: MaskFree,
}

impl Updates for Running<'_> {
    fn core(&mut self) -> &mut Core {
        self.core
    }

    fn update(&mut self) -> Result<Updated, TrainingError> {
        let Self { core, learner, batches, mask_free, .. } = self;
        let (number, seed) = (core.state.updates, core.settings.seed);
        let batch = core.interval.time(TimeBucket::WaitingForBatches, || batches.next_batch())?;
        let update = core.interval.time(TimeBucket::Learning, || learner.update(batch, seed, number))?;
        core.interval.update(&json!({"losses": update.losses, "gradient_norm": update.gradient_norm}));
        if update.losses.robot_mask.is_none() {
            mask_free.sum += update.losses.total;
            mask_free.count += 1;
        }
        let stage = if number < core.settings.pretrain.warm_up_updates { "warm_up" } else { "mask_free" };
        let averaged: Option<fn(&str) -> bool> = learner.leaves_average().then_some(Trained::World.filter());
        Ok((stage, averaged))
    }

    fn save(&mut self) -> Result<Option<HeldOutLosses>, TrainingError> {
        let Self { core, learner, held_out, mask_free, .. } = self;
        let adam = learner.write_back(&core.parameters, &mut core.run)?;
        let agent = core.agent()?;
        let (sizes, world) = (&core.settings.replay, &core.settings.world);
        let held_out = held_out.losses(&agent, sizes, world, &core.device, learner)?;
        let mask_free = std::mem::take(mask_free).mean();
        let best = match &held_out {
            Some(losses) => lower(Some(losses.total), &mut core.state.best_held_out_loss),
            None => lower(mask_free, &mut core.state.best_loss),
        };
        let update = core.state.updates;
        let line = held_out.map(|held_out| HeldOutLosses { update, held_out, best: best == Best::Yes });
        // Before the checkpoint: who dies in between loses both, because a resumed run drops lines beyond its checkpoint.
        if let Some(line) = &line {
            core.run.log(line)?;
        }
        core.write(&agent, &[(WORLD, &adam)], best, core.settings.pretrain.warm_up_updates)?;
        Ok(line)
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
