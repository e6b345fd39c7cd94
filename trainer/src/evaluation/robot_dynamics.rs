use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::Device;
use serde::{Deserialize, Serialize};

use super::open_loop::{filtered, imagined, joined};
use super::{EvaluationError, Film, Measure, TaskTrajectories, Trace, traces};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};

/// Trajectories at a time: bounds the memory of the painted pictures.
const ROWS: usize = 10;

/// How latents are chosen from their distributions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Latents {
    /// Drawn, by the seed.
    Sample,
    /// The most probable class.
    Mode,
}

impl Latents {
    /// Its name in files and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sample => "sample",
            Self::Mode => "mode",
        }
    }
}

/// How models are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OpenLoopSettings {
    /// Trajectories a task.
    pub trajectories: usize,
    /// Steps that are seen.
    pub context: usize,
    /// Steps that are imagined after them.
    pub imagined: usize,
    /// How latents are chosen.
    pub latents: Latents,
    /// Seed of trajectories, draws and intervals.
    pub seed: u64,
    /// Films a task and model.
    pub films: usize,
}

impl Default for OpenLoopSettings {
    /// The paper's (Fig. 4).
    fn default() -> Self {
        Self { trajectories: 100, context: 10, imagined: 54, latents: Latents::Sample, seed: 0, films: 2 }
    }
}

/// A model on a task's trajectories: a trace each, of the steps after the context.
#[derive(Debug, Default)]
pub struct Measured {
    /// Of what was imagined.
    pub imagined: Vec<Trace>,
    /// Of posterior states at the same steps: the model sees every image.
    pub posterior: Vec<Trace>,
    /// Films of the first trajectories.
    pub films: Vec<Film>,
}

impl Measured {
    /// Mean robot dynamics error of every imagined trajectory.
    #[must_use]
    pub fn robot_errors(&self) -> Vec<Option<f64>> {
        self.imagined.iter().map(|trace| trace.mean(Measure::RobotError)).collect()
    }
}

/// Measures a frozen agent on a task's trajectories; `seen` hears of every trajectory.
///
/// # Errors
/// [`EvaluationError::Interrupted`] once `stop` is set, or those of candle.
pub fn measure(
    agent: &Agent,
    task: &TaskTrajectories,
    settings: &OpenLoopSettings,
    device: &Device,
    stop: &AtomicBool,
    mut seen: impl FnMut(usize),
) -> Result<Measured, EvaluationError> {
    let mut measured = Measured::default();
    for from in (0..task.chosen.len()).step_by(ROWS) {
        if stop.load(Ordering::Relaxed) {
            return Err(EvaluationError::Interrupted);
        }
        let to = (from + ROWS).min(task.chosen.len());
        let films = settings.films.saturating_sub(from).min(to - from);
        measure_rows(agent, task, (from, to), settings, films, device, &mut measured)?;
        seen(to - from);
    }
    Ok(measured)
}

/// One batch: rows `from` to `to`, with films of the first of them.
fn measure_rows(
    agent: &Agent,
    task: &TaskTrajectories,
    (from, to): (usize, usize),
    settings: &OpenLoopSettings,
    films: usize,
    device: &Device,
    into: &mut Measured,
) -> Result<(), EvaluationError> {
    let (world, context, length) = (&agent.world, settings.context, task.length);
    let batch = task.batch(from, to, device)?;
    let mut sampler = match settings.latents {
        Latents::Sample => Sampler::numbered(settings.seed, from as u64),
        Latents::Mode => Sampler::Mode,
    };
    let posteriors = filtered(world, &batch, length, &mut sampler)?;
    // A posterior knows nothing of later images: that of the last context step starts the imagination.
    let imagined = imagined(world, &batch, &posteriors, context, &mut sampler)?;
    let decoded = world.decode(&imagined)?;
    into.imagined.extend(traces(agent, &batch, &imagined, &decoded, context)?);
    let seen = steps(&posteriors, context, length - context)?;
    into.posterior.extend(traces(agent, &batch, &seen, &world.decode(&seen)?, context)?);
    if films > 0 {
        let whole = joined(&steps(&posteriors, 0, context)?, &imagined)?;
        let shown = whole.map(|x| x.narrow(0, 0, films)?.contiguous())?;
        let decoded = world.decode(&shown)?;
        for row in 0..films {
            into.films.push(Film::of(&batch.image, &decoded, row, context)?);
        }
    }
    Ok(())
}

fn steps(states: &State, from: usize, count: usize) -> candle_core::Result<State> {
    states.map(|x| x.narrow(1, from, count)?.contiguous())
}
