//! What all phases of training do alike: updates until there are enough, a line of metrics now and then, checkpoints, films.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use candle_core::Device;
use rcwm_models::tensors::Tensors;

use super::film::{Scene, write_films};
use super::run::Resume;
use super::{
    Best, HeldOutLosses, Interval, Line, Phase, Run, TrainingError, TrainingSettings, TrainingState,
};
use crate::learning::{Adam, AdamSettings};
use crate::model::agent::Agent;
use crate::model::parameters::Parameters;

/// What every phase has: its folder, what it learns, and what it has done.
#[derive(Debug)]
pub(super) struct Core {
    pub settings: TrainingSettings,
    pub device: Device,
    pub run: Run,
    pub parameters: Parameters,
    pub state: TrainingState,
    pub interval: Interval,
    /// What films are made of.
    pub scenes: Vec<Scene>,
    /// The update that was saved last.
    saved_at: Option<u64>,
}

/// Where a phase goes on from: what optimisers have remembered.
pub(super) struct Moments(Option<Tensors>);

impl Core {
    /// A new run in `folder`, on parameters that `begin` gives.
    pub fn create(
        folder: &Path,
        settings: TrainingSettings,
        device: Device,
        begin: impl FnOnce(&TrainingSettings, &Device) -> Result<Parameters, TrainingError>,
    ) -> Result<Self, TrainingError> {
        settings.validate()?;
        let run = Run::create(folder, &settings)?;
        let parameters = begin(&settings, &device)?;
        Ok(Self::of(run, settings, device, parameters, TrainingState::default()))
    }

    /// Goes on with the run in `folder` from its newest checkpoint, or from the beginning if there is none yet.
    pub fn resume(
        folder: &Path,
        settings: TrainingSettings,
        device: Device,
        phases: &[Phase],
        begin: impl FnOnce(&TrainingSettings, &Device) -> Result<Parameters, TrainingError>,
    ) -> Result<(Self, Moments), TrainingError> {
        Ok(match Run::go_on(folder, &settings, phases, &device)? {
            Resume::FromStart(run) => {
                let parameters = begin(&settings, &device)?;
                (Self::of(run, settings, device, parameters, TrainingState::default()), Moments(None))
            }
            Resume::From { run, parameters, state, moments } => {
                (Self::of(run, settings, device, parameters, state), Moments(Some(moments)))
            }
        })
    }

    fn of(
        run: Run,
        settings: TrainingSettings,
        device: Device,
        parameters: Parameters,
        state: TrainingState,
    ) -> Self {
        let (interval, scenes) = (Interval::begin(), Vec::new());
        Self { settings, device, run, parameters, state, interval, scenes, saved_at: None }
    }

    /// An optimiser as it was when the run was saved; none in a run from the beginning.
    pub fn adam(
        &self,
        name: &str,
        settings: &AdamSettings,
        Moments(moments): &Moments,
    ) -> Result<Option<Adam>, TrainingError> {
        let adam = |moments| self.state.optimiser(name, settings, moments, &self.parameters);
        Ok(moments.as_ref().map(adam).transpose()?)
    }

    /// What a checkpoint holds.
    pub fn agent(&self) -> Result<Agent, TrainingError> {
        Ok(Agent::new(&self.run.ema_weights(&self.parameters).frozen(), &self.settings.model)?)
    }

    /// Writes a checkpoint, and draws its curves and films. `warm_up` updates are marked in the curves.
    pub fn write(
        &mut self,
        agent: &Agent,
        optimisers: &[(&str, &Adam)],
        best: Best,
        warm_up: u64,
    ) -> Result<(), TrainingError> {
        let Self { settings, device, run, parameters, state, scenes, .. } = self;
        self.saved_at = Some(state.updates);
        run.save(parameters, settings, state, optimisers, best)?;
        run.draw_curves(warm_up)?;
        write_films(run, agent, scenes, &settings.film, state.updates, device)
    }
}

/// What an update was: the stage's name in metrics, and which weights the run's average is to follow, where it is not kept elsewhere.
pub(super) type Updated = (&'static str, Option<fn(&str) -> bool>);

/// A phase's own part of an update and of a checkpoint.
pub(super) trait Updates {
    fn core(&mut self) -> &mut Core;

    /// Makes one update.
    fn update(&mut self) -> Result<Updated, TrainingError>;

    /// Saves a checkpoint; what it is worth, where that is measured.
    fn save(&mut self) -> Result<Option<HeldOutLosses>, TrainingError>;

    /// Adds to a line of metrics.
    fn tell(&mut self, _line: &mut Line) {}
}

/// Where a run stands after an update, for whoever shows it.
#[derive(Debug, Clone)]
pub struct Progress<'a> {
    /// Updates made.
    pub updates: u64,
    /// The newest line of metrics, when there is a new one.
    pub line: Option<&'a Line>,
    /// What the checkpoint that was just saved gives on the held-out episodes.
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

/// Makes updates until there are `until` of them or `stop` is set.
pub(super) fn make_updates<U: Updates>(
    phase: &mut U,
    until: u64,
    stop: &AtomicBool,
    show: &mut dyn FnMut(&mut U, &Progress<'_>),
) -> Result<(), TrainingError> {
    while phase.core().state.updates < until && !stop.load(Ordering::Relaxed) {
        let (stage, averaged) = phase.update()?;
        let core = phase.core();
        core.state.updates += 1;
        let updates = core.state.updates;
        if let Some(may_have_moved) = averaged {
            core.run.ema_update(&core.parameters, may_have_moved, updates)?;
        }
        let mut line =
            updates.is_multiple_of(core.settings.metrics_every).then(|| core.interval.end(updates, stage));
        if let Some(line) = &mut line {
            phase.tell(line);
            phase.core().run.log(line)?;
        }
        let mut held_out = None;
        if updates.is_multiple_of(phase.core().settings.checkpoint_every) {
            let begin = Instant::now();
            held_out = phase.save()?;
            // Updates a second are those of training.
            phase.core().interval.leave_out(begin.elapsed());
        }
        show(phase, &Progress { updates, line: line.as_ref(), held_out: held_out.as_ref() });
    }
    Ok(())
}

/// The same, and a checkpoint at the end where there is none yet.
pub(super) fn make_all_updates<U: Updates>(
    phase: &mut U,
    until: u64,
    stop: &AtomicBool,
    mut show: impl FnMut(&Progress<'_>),
) -> Result<Outcome, TrainingError> {
    phase.core().interval = Interval::begin();
    make_updates(phase, until, stop, &mut |_, progress| show(progress))?;
    let updates = phase.core().state.updates;
    if phase.core().saved_at != Some(updates) {
        phase.save()?;
    }
    Ok(Outcome { updates, interrupted: updates < until })
}
