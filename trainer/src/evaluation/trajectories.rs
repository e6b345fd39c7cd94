use std::sync::Arc;

use candle_core::Device;
use rand::seq::{SliceRandom, index};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::Episode;

use super::EvaluationError;
use crate::learning::{Batch, HostBatch};
use crate::replay::{Replay, append_steps};

/// A stretch of an episode.
#[derive(Debug, Clone)]
pub struct Trajectory {
    /// The episode, and which of the task's it is.
    pub episode: Arc<Episode>,
    /// Number of the episode among those that were chosen from.
    pub number: usize,
    /// Its first step in the episode.
    pub start: usize,
}

/// The trajectories of one task.
#[derive(Debug, Clone)]
pub struct TaskTrajectories {
    /// The task.
    pub task: String,
    /// Steps of each.
    pub length: usize,
    /// What was chosen.
    pub chosen: Vec<Trajectory>,
}

impl TaskTrajectories {
    /// Chooses `count` trajectories of `length` steps for every task: of as many episodes with masks as there are, equally many of
    /// each, at starts drawn by `seed` of which none comes twice. Where episodes are few and short there may be fewer than `count`.
    ///
    /// # Errors
    /// [`EvaluationError::NoMasks`], or [`EvaluationError::NoTrajectories`] if a task's masked episodes are too short.
    pub fn choose(
        replay: &Replay,
        count: usize,
        length: usize,
        seed: u64,
    ) -> Result<Vec<Self>, EvaluationError> {
        let replay = replay.masked();
        if replay.episodes() == 0 {
            return Err(EvaluationError::NoMasks);
        }
        let of = |(task, episodes): (&str, Vec<&Arc<Episode>>)| {
            let fits = |episode: &&&Arc<Episode>| episode.len() >= length;
            let fitting: Vec<_> = episodes.iter().filter(fits).copied().collect();
            if fitting.is_empty() {
                let task = task.to_owned();
                return Err(EvaluationError::NoTrajectories { task, episodes: episodes.len(), length });
            }
            Ok(Self { task: task.to_owned(), length, chosen: choose(&fitting, count, length, seed) })
        };
        replay.tasks().map(of).collect()
    }

    /// One trajectory of at most `length` steps, from the first step of an episode with masks that the seed draws, of those that
    /// succeeded where there are such: what comes before an object is touched is in it. None where no episode has two steps.
    #[must_use]
    pub fn whole(replay: &Replay, task: &str, length: usize, seed: u64) -> Option<Self> {
        let replay = replay.masked();
        let (_, episodes) = replay.tasks().find(|(name, _)| *name == task)?;
        let longest = episodes.iter().map(|episode| episode.len()).max()?.min(length);
        let fits = |episode: &Episode| longest > 1 && episode.len() >= longest;
        let fitting = || episodes.iter().enumerate().filter(|(_, episode)| fits(episode));
        let solved: Vec<_> = fitting().filter(|(_, episode)| episode.succeeded()).collect();
        let from = if solved.is_empty() { fitting().collect() } else { solved };
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (number, episode) = from.get(random.random_range(0..from.len().max(1)))?;
        let trajectory = Trajectory { episode: Arc::clone(episode), number: *number, start: 0 };
        Some(Self { task: task.to_owned(), length: longest, chosen: vec![trajectory] })
    }

    /// Which episode each is of.
    #[must_use]
    pub fn numbers(&self) -> Vec<usize> {
        self.chosen.iter().map(|trajectory| trajectory.number).collect()
    }

    /// Number of episodes they are of.
    #[must_use]
    pub fn episodes(&self) -> usize {
        let mut numbers = self.numbers();
        numbers.sort_unstable();
        numbers.dedup();
        numbers.len()
    }

    /// Trajectories `from` to `to` as a batch with masks.
    ///
    /// # Errors
    /// Those of candle.
    pub fn batch(&self, from: usize, to: usize, device: &Device) -> Result<Batch, EvaluationError> {
        let mut batch = HostBatch { rows: to - from, length: self.length, ..HostBatch::default() };
        for Trajectory { episode, start, .. } in &self.chosen[from..to] {
            append_steps(&self.task, episode, *start, self.length, true, &mut batch)?;
        }
        Ok(batch.into_tensors(device)?)
    }
}

fn choose(episodes: &[&Arc<Episode>], count: usize, length: usize, seed: u64) -> Vec<Trajectory> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut order: Vec<usize> = (0..episodes.len()).collect();
    order.shuffle(&mut random);
    let mut chosen = Vec::with_capacity(count);
    for (turn, number) in order.iter().enumerate() {
        let share = count / order.len() + usize::from(turn < count % order.len());
        let starts = episodes[*number].len() - length + 1;
        let drawn = index::sample(&mut random, starts, share.min(starts));
        let episode = |start| Trajectory { episode: Arc::clone(episodes[*number]), number: *number, start };
        chosen.extend(drawn.into_iter().map(episode));
    }
    // Neighbours are of different episodes: the first few, which films are made of, show more.
    chosen.shuffle(&mut random);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_trajectory_begins_an_episode_that_was_solved() {
        let mut replay = Replay::new(usize::MAX);
        for (steps, solved) in [(30, false), (20, true), (30, true), (5, true)] {
            let mut episode = Episode::blank(steps);
            episode.robot_mask = Some(ndarray::Array3::from_elem((steps, 64, 64), false));
            episode.success[steps - 1] = solved;
            replay.add("hammer", episode).unwrap();
        }
        for seed in 0..10 {
            let found = TaskTrajectories::whole(&replay, "hammer", 25, seed).unwrap();
            assert_eq!((found.length, found.chosen[0].start, found.numbers()), (25, 0, vec![2]));
        }
        let longest = TaskTrajectories::whole(&replay, "hammer", 99, 0).unwrap();
        assert_eq!(longest.length, 30, "as long as there are");
        assert!(TaskTrajectories::whole(&replay, "reach", 25, 0).is_none());
    }
}
