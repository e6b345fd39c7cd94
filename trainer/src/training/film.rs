use std::sync::Arc;

use candle_core::Device;
use rcwm_models::episode::Episode;

use super::{FilmSettings, Run, TrainingError};
use crate::evaluation::{Film, open_loop};
use crate::learning::HostBatch;
use crate::model::agent::Agent;
use crate::model::latent::Sampler;
use crate::replay::{Replay, append_steps};

/// A task and an episode of it to make films of.
pub(super) type Scene = (String, Arc<Episode>);

impl FilmSettings {
    /// A task and its first episode that is long enough to imagine some of, for every task.
    pub(super) fn scenes(&self, replay: &Replay) -> Vec<Scene> {
        let long = |episode: &&Arc<Episode>| self.length > 0 && episode.len() > self.context;
        let first = |(task, episodes): (&str, Vec<&Arc<Episode>>)| {
            Some((task.to_owned(), Arc::clone(episodes.into_iter().find(long)?)))
        };
        replay.tasks().filter_map(first).collect()
    }
}

/// Makes a film of every scene: a strip of this update, and the newest in motion.
///
/// # Errors
/// Those of making and writing them.
pub(super) fn write_films(
    run: &Run,
    agent: &Agent,
    scenes: &[Scene],
    settings: &FilmSettings,
    update: u64,
    device: &Device,
) -> Result<(), TrainingError> {
    for (task, episode) in scenes {
        let film = film(agent, episode, settings, device)?;
        let films = run.films()?;
        film.write_strip(settings.every, &films.join(format!("{update:06}-{task}.png")))?;
        film.write_gif(&films.join(format!("{task}.gif")))?;
    }
    Ok(())
}

/// What a model sees, then imagines with the recorded actions, of the first steps of an episode. The most probable class is taken
/// throughout, so that films of two checkpoints differ by the model only.
///
/// # Errors
/// Those of candle; the episode must be longer than the context.
pub fn film(
    agent: &Agent,
    episode: &Episode,
    settings: &FilmSettings,
    device: &Device,
) -> Result<Film, TrainingError> {
    let length = settings.length.min(episode.len());
    let context = settings.context.clamp(1, length.saturating_sub(1).max(1));
    let states = episode.proprio.is_some();
    let mut batch = HostBatch { rows: 1, length, states, ..HostBatch::default() };
    append_steps("", episode, 0, length, false, &mut batch)?;
    let batch = batch.into_tensors(device)?;
    let states = open_loop(&agent.world, &batch, context, &mut Sampler::Mode)?;
    Ok(Film::of(&batch.image, &agent.world.decode(&states)?, 0, context)?)
}
