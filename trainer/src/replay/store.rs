use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use ndarray::Axis;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelSettings;
use serde::{Deserialize, Serialize};

use super::ReplayError;
use crate::learning::{HostBatch, Look, LookSettings};

/// Where sequences begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Starts {
    /// At any step, each equally likely.
    #[default]
    Anywhere,
    /// Every other one at the first step of an episode, each episode equally likely: what is seen only there must be remembered.
    Episodes,
}

/// An episode and when it came.
#[derive(Debug, Clone)]
pub(super) struct Stored {
    pub(super) episode: Arc<Episode>,
    number: u64,
    /// Where its images begin in a store, and those that it is seen by when it is disturbed.
    place: Option<(u32, u32)>,
}

/// One task's episodes, oldest first.
#[derive(Debug, Clone, Default)]
pub(super) struct Task {
    pub(super) episodes: VecDeque<Stored>,
    pub(super) steps: usize,
}

/// Where an episode is in a store of images.
#[derive(Debug, Clone)]
pub struct Placed {
    pub episode: Arc<Episode>,
    /// The place of its first image.
    pub images: u32,
    /// The place of its first disturbed picture; that of the images where these are not stored.
    pub seen: u32,
}

impl Placed {
    /// The place behind it.
    #[must_use]
    pub fn end(&self) -> usize {
        self.images.max(self.seen) as usize + self.episode.len()
    }
}

/// Episodes by task, up to a number of steps; the oldest go first.
#[derive(Debug, Clone)]
pub struct Replay {
    pub(super) tasks: BTreeMap<String, Task>,
    pub(super) capacity: usize,
    pub(super) steps: usize,
    pub(super) next_number: u64,
    look: LookSettings,
    /// Whose sizes every episode must have.
    pub(super) model: Option<ModelSettings>,
}

impl Replay {
    /// An empty replay that holds at most `capacity` steps.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        Self {
            tasks: BTreeMap::new(),
            capacity,
            steps: 0,
            next_number: 0,
            look: LookSettings::default(),
            model: None,
        }
    }

    /// Refuses episodes of other sizes than this model's from now on, and draws the robot's measured state if it looks at one.
    #[must_use]
    pub fn fitting(self, model: &ModelSettings) -> Self {
        Self { model: Some(model.clone()), ..self }
    }

    /// Has the encoders see what is drawn from now on as these settings say.
    pub fn look(&mut self, settings: &LookSettings) {
        self.look = *settings;
    }

    /// Steps held.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Episodes held.
    #[must_use]
    pub fn episodes(&self) -> usize {
        self.tasks.values().map(|task| task.episodes.len()).sum()
    }

    /// The tasks with their episodes, oldest first.
    pub fn tasks(&self) -> impl Iterator<Item = (&str, Vec<&Arc<Episode>>)> {
        self.tasks
            .iter()
            .map(|(name, task)| (name.as_str(), task.episodes.iter().map(|stored| &stored.episode).collect()))
    }

    /// Adds an episode; where there is no room, the oldest episodes of the task with the most steps leave.
    ///
    /// # Errors
    /// See [`ReplayError`]; nothing is changed then.
    pub fn add(&mut self, task: &str, episode: impl Into<Arc<Episode>>) -> Result<(), ReplayError> {
        let episode = episode.into();
        check_episode(task, &episode)?;
        if let Some(misfit) = self.model.as_ref().and_then(|model| episode.misfit(model)) {
            return Err(ReplayError::Misfit { task: task.to_owned(), misfit });
        }
        let steps = episode.len();
        if steps > self.capacity {
            return Err(ReplayError::TooLong { task: task.to_owned(), steps, capacity: self.capacity });
        }
        while self.steps + steps > self.capacity {
            self.drop_oldest();
        }
        let number = self.next_number;
        self.next_number += 1;
        let home = self.tasks.entry(task.to_owned()).or_default();
        home.episodes.push_back(Stored { episode, number, place: None });
        home.steps += steps;
        self.steps += steps;
        Ok(())
    }

    fn drop_oldest(&mut self) {
        let age = |task: &Task| task.episodes.front().map_or(u64::MAX, |stored| stored.number);
        // Of tasks equally full, the one whose oldest episode is older gives way.
        let fullest = self.tasks.values_mut().max_by_key(|task| (task.steps, std::cmp::Reverse(age(task))));
        if let Some(task) = fullest
            && let Some(oldest) = task.episodes.pop_front()
        {
            task.steps -= oldest.episode.len();
            self.steps -= oldest.episode.len();
        }
        self.tasks.retain(|_, task| !task.episodes.is_empty());
    }

    /// Gives the images of every episode a place in a store, from `from` on, and where `disturbed` its disturbed pictures the places
    /// behind them; the first place that is free. Batches name places from then on, in place of images and masks.
    pub fn place_images(&mut self, from: u32, disturbed: bool, mut put: impl FnMut(Placed)) -> u32 {
        let mut next = from;
        for stored in self.tasks.values_mut().flat_map(|task| &mut task.episodes) {
            let (images, steps) = (next, stored.episode.len() as u32);
            next += steps;
            let mut seen = images;
            if disturbed && stored.episode.disturbed.is_some() {
                (seen, next) = (next, next + steps);
            }
            stored.place = Some((images, seen));
            put(Placed { episode: stored.episode.clone(), images, seen });
        }
        next
    }

    /// The episodes that have robot masks; they share their memory with this replay's.
    #[must_use]
    pub fn masked(&self) -> Self {
        let mut masked = Self::new(self.capacity);
        (masked.next_number, masked.look, masked.model) = (self.next_number, self.look, self.model.clone());
        for (name, task) in &self.tasks {
            let with_mask = |stored: &&Stored| stored.episode.robot_mask.is_some();
            let episodes: VecDeque<_> = task.episodes.iter().filter(with_mask).cloned().collect();
            if !episodes.is_empty() {
                let steps = episodes.iter().map(|stored| stored.episode.len()).sum();
                masked.tasks.insert(name.clone(), Task { episodes, steps });
                masked.steps += steps;
            }
        }
        masked
    }

    /// Draws batch `number` of a seed: `rows` sequences of `length` steps.
    ///
    /// # Errors
    /// [`ReplayError::NothingToDraw`] or [`ReplayError::NoMasks`].
    pub fn draw(
        &self,
        rows: usize,
        length: usize,
        masks: bool,
        seed: u64,
        number: u64,
    ) -> Result<HostBatch, ReplayError> {
        self.draw_from(Starts::Anywhere, rows, length, masks, seed, number)
    }

    /// [`Replay::draw`] of sequences that begin where `starts` says.
    ///
    /// # Errors
    /// [`ReplayError::NothingToDraw`] or [`ReplayError::NoMasks`].
    pub fn draw_from(
        &self,
        starts: Starts,
        rows: usize,
        length: usize,
        masks: bool,
        seed: u64,
        number: u64,
    ) -> Result<HostBatch, ReplayError> {
        if self.tasks.is_empty() {
            return Err(ReplayError::NothingToDraw { masks });
        }
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(number);
        let states = self.model.as_ref().is_some_and(|model| model.state > 0);
        let mut batch = HostBatch { rows, length, number, masks, states, ..HostBatch::default() };
        let tasks: Vec<_> = self.tasks.iter().collect();
        // The turn goes on from batch to batch, so that shares are equal also where they do not divide a batch.
        let turn = (number % tasks.len() as u64) as usize * (rows % tasks.len());
        for row in 0..rows {
            let (name, task) = tasks[(turn + row) % tasks.len()];
            let start = match starts {
                Starts::Episodes if row.is_multiple_of(2) => {
                    task.first_step_of(generator.random_range(0..task.episodes.len()))
                }
                _ => generator.random_range(0..task.steps),
            };
            let look = (!self.look.is_plain()).then(|| self.look.drawn(seed, number, row));
            task.append(name, start, length, masks, look.as_ref(), &mut batch)?;
        }
        Ok(batch)
    }
}

impl Task {
    /// Where an episode begins among all steps of this task.
    fn first_step_of(&self, episode: usize) -> usize {
        self.episodes.iter().take(episode).map(|stored| stored.episode.len()).sum()
    }

    /// Appends `length` steps that begin at step `start` of all this task's steps.
    fn append(
        &self,
        name: &str,
        start: usize,
        length: usize,
        masks: bool,
        look: Option<&Look>,
        batch: &mut HostBatch,
    ) -> Result<(), ReplayError> {
        let from = batch.seen.len();
        let (mut index, mut step) = (0, start);
        while step >= self.episodes[index].episode.len() {
            step -= self.episodes[index].episode.len();
            index += 1;
        }
        let mut left = length;
        while left > 0 {
            let Stored { episode, place, .. } = &self.episodes[index];
            let count = left.min(episode.len() - step);
            match place {
                Some((place, _)) => append_places(name, episode, *place, step, count, batch)?,
                None => append_steps(name, episode, step, count, masks, batch)?,
            }
            if let (Some(look), Some((place, disturbed))) = (look, *place) {
                let from = if look.disturbed { disturbed } else { place } + step as u32;
                batch.seen_place.extend(from..from + count as u32);
            } else if let Some(look) = look {
                let disturbed = episode.disturbed.as_ref().filter(|_| look.disturbed);
                let range = ndarray::Slice::from(step..step + count);
                batch.seen.extend(disturbed.unwrap_or(&episode.image).slice_axis(Axis(0), range));
            }
            left -= count;
            step = 0;
            index = (index + 1) % self.episodes.len();
        }
        let jitter = look.and_then(|look| look.jitter);
        if let Some(jitter) = jitter {
            jitter.apply(&mut batch.seen[from..]);
        }
        if !batch.seen_place.is_empty() {
            batch.seen_jitter.push(jitter);
        }
        Ok(())
    }
}

/// Appends steps `from` to `from + count` of an episode of the task `name` to a batch.
///
/// # Errors
/// [`ReplayError::NoMasks`] if `masks` are wanted and there are none.
pub fn append_steps(
    name: &str,
    episode: &Episode,
    from: usize,
    count: usize,
    masks: bool,
    batch: &mut HostBatch,
) -> Result<(), ReplayError> {
    let range = ndarray::Slice::from(from..from + count);
    batch.image.extend(episode.image.slice_axis(Axis(0), range));
    append_facts(episode, from, count, batch);
    if masks {
        batch.masks = true;
        let mask = masks_of(name, episode)?;
        batch.robot_mask.extend(mask.slice_axis(Axis(0), range).iter().map(|robot| u8::from(*robot)));
    }
    Ok(())
}

/// The same of an episode whose images and masks lie in a store from `place` on.
fn append_places(
    name: &str,
    episode: &Episode,
    place: u32,
    from: usize,
    count: usize,
    batch: &mut HostBatch,
) -> Result<(), ReplayError> {
    batch.place.extend((from..from + count).map(|step| place + step as u32));
    append_facts(episode, from, count, batch);
    if batch.masks { masks_of(name, episode).map(drop) } else { Ok(()) }
}

fn masks_of<'a>(name: &str, episode: &'a Episode) -> Result<&'a ndarray::Array3<bool>, ReplayError> {
    episode.robot_mask.as_ref().ok_or_else(|| ReplayError::NoMasks { task: name.to_owned() })
}

/// Everything of some steps but their pictures.
fn append_facts(episode: &Episode, from: usize, count: usize, batch: &mut HostBatch) {
    let range = ndarray::Slice::from(from..from + count);
    batch.side = episode.side();
    batch.action.extend(episode.action.slice_axis(Axis(0), range));
    if let Some(state) = episode.proprio.as_ref().filter(|_| batch.states) {
        batch.state.extend(state.slice_axis(Axis(0), range));
    }
    batch.reward.extend(episode.reward.slice_axis(Axis(0), range));
    batch.terminal.extend(episode.is_terminal.slice_axis(Axis(0), range));
    // What a file does not say of its first step is true all the same: nothing came before it.
    batch.first.extend((from..from + count).map(|step| step == 0 || episode.is_first[step]));
    batch.pushed.extend(episode.pushed.slice_axis(Axis(0), range));
}

/// Refuses an episode without steps or with numbers that are not finite.
///
/// # Errors
/// [`ReplayError::Empty`] or [`ReplayError::NotFinite`].
pub(crate) fn check_episode(task: &str, episode: &Episode) -> Result<(), ReplayError> {
    if episode.is_empty() {
        return Err(ReplayError::Empty { task: task.to_owned() });
    }
    let not_finite = |what, step| Err(ReplayError::NotFinite { task: task.to_owned(), what, step });
    if let Some(step) = episode.reward.iter().position(|reward| !reward.is_finite()) {
        return not_finite("reward", step);
    }
    let rows = episode.action.outer_iter();
    if let Some(step) = rows.into_iter().position(|action| action.iter().any(|x| !x.is_finite())) {
        return not_finite("action", step);
    }
    Ok(())
}

#[cfg(test)]
mod tests;
