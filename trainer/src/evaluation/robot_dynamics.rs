use std::sync::atomic::{AtomicBool, Ordering};

use super::attention::maps_of;
use super::open_loop::{filtered, joined};
use super::response::{Differences, differences};
use super::{
    AttentionMaps, AttentionSpread, EvaluationError, Film, Latents, Measure, OpenLoopSettings, ResponseFilm,
    TaskTrajectories, Trace, traces,
};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};
use candle_core::Device;

/// Trajectories at a time: bounds the memory of the decoded pictures.
const ROWS: usize = 10;

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
