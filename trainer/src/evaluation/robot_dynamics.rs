use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::Device;
use serde::{Deserialize, Serialize};

use super::attention::maps_of;
use super::open_loop::{filtered, joined};
use super::response::{Differences, differences};
use super::{
    AttentionMaps, AttentionSpread, EvaluationError, Film, Measure, OtherActions, ResponseFilm,
    TaskTrajectories, Trace, Windows, traces,
};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};

/// Trajectories at a time: bounds the memory of the decoded pictures.
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
    /// Which stretches of episodes.
    #[serde(default = "Windows::of_older_files")]
    pub windows: Windows,
    /// What is done in place of the recorded actions to see what depends on them; none in files from before it was measured.
    pub other_actions: Option<OtherActions>,
}

impl Default for OpenLoopSettings {
    /// Sizes are the paper's (Fig. 4).
    fn default() -> Self {
        Self {
            trajectories: 100,
            context: 10,
            imagined: 54,
            latents: Latents::Sample,
            seed: 0,
            films: 2,
            windows: Windows::Moving,
            other_actions: Some(OtherActions::Still),
        }
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
    /// How other actions change what is imagined; empty where that is not measured.
    pub differences: Vec<Differences>,
    /// Films of the first trajectories by the recorded actions and by others.
    pub response_films: Vec<ResponseFilm>,
    /// What the environment asks of the robot at the imagined steps; empty for a model without interaction.
    pub attention: AttentionMaps,
}

impl Measured {
    /// How the attention is spread over queries and states; none for a model without interaction.
    #[must_use]
    pub fn attention(&self) -> Option<AttentionSpread> {
        self.attention.spread()
    }

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
    let counted: Vec<usize> = task.chosen[from..to].iter().map(|trajectory| trajectory.steps).collect();
    let posteriors = filtered(world, &batch, length, &mut sampler)?;
    // A posterior knows nothing of later images: that of the last context step starts the imagination. Other actions get the same draws.
    let mut again = sampler.clone();
    let start = steps(&posteriors, context - 1, 1)?.map(|x| x.squeeze(1)?.contiguous())?;
    let actions = batch.action.narrow(1, context, length - context)?;
    let imagined = match world.imagine_attending(&start, &actions, &mut sampler)? {
        Some((states, maps)) => {
            if into.attention.is_empty() {
                into.attention = AttentionMaps::new(maps.dim(2)?);
            }
            for (row, steps) in counted.iter().enumerate() {
                into.attention.extend(maps_of(&maps, row, steps - context)?);
            }
            states
        }
        None => world.imagine(&start, &actions, &mut sampler)?,
    };
    let decoded = world.decode(&imagined)?;
    let seen = steps(&posteriors, context, length - context)?;
    for (into, states, decoded) in
        [(&mut into.imagined, &imagined, &decoded), (&mut into.posterior, &seen, &world.decode(&seen)?)]
    {
        let mut traces = traces(agent, &batch, states, decoded, context)?;
        traces.iter_mut().zip(&counted).for_each(|(trace, steps)| trace.end_after(steps - context));
        into.extend(traces);
    }
    if let Some(other) = settings.other_actions {
        let states = world.imagine(&start, &other.of(&batch, context)?, &mut again)?;
        let others = world.decode(&states)?;
        into.differences.extend(differences(&batch, &decoded, &others, context, &counted)?);
        for (row, steps) in counted.iter().enumerate().take(films) {
            let pair = (&decoded, &others);
            into.response_films.push(ResponseFilm::of(&batch.image, pair, other, row, (context, *steps))?);
        }
    }
    if films > 0 {
        let whole = joined(&steps(&posteriors, 0, context)?, &imagined)?;
        let shown = whole.map(|x| x.narrow(0, 0, films)?.contiguous())?;
        let decoded = world.decode(&shown)?;
        for (row, steps) in counted.iter().enumerate().take(films) {
            into.films.push(Film::of(&batch.image.narrow(1, 0, *steps)?, &decoded, row, context)?);
        }
    }
    Ok(())
}

fn steps(states: &State, from: usize, count: usize) -> candle_core::Result<State> {
    states.map(|x| x.narrow(1, from, count)?.contiguous())
}
