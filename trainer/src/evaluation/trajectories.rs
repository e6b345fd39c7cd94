use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use super::motion::robot_moves;
use super::{EvaluationError, OpenLoopSettings, Recording, Recordings, Windows};
use crate::learning::{Batch, HostBatch};
use crate::replay::append_steps;
use candle_core::Device;
use rand::seq::{SliceRandom, index};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::Episode;

/// Imagined steps that a window must have at least where it ends with success: as many as behaviour is learnt from.
const IMAGINED_LEAST: usize = 15;

/// A stretch of an episode.
#[derive(Debug, Clone)]
pub struct Trajectory {
    /// The episode, and which of the task's it is.
    pub episode: Arc<Episode>,
    /// Number of the episode among those that were chosen from.
    pub number: usize,
    /// Who decided in it.
    pub kind: &'static str,
    /// Its first step in the episode.
    pub start: usize,
    /// How many of its steps count, context included: at most as many as the others of its task have.
    pub steps: usize,
}

#[derive(Debug, Clone)]
pub struct TaskTrajectories {
    pub task: String,
    /// Steps of the longest.
    pub length: usize,
    /// What was chosen.
    pub chosen: Vec<Trajectory>,
}

impl TaskTrajectories {
    /// Chooses trajectories for every task: of as many episodes as there are, equally many of each, at starts drawn by the seed of which
    /// none comes twice. Where episodes are few and short there may be fewer than the settings say.
    ///
    /// # Errors
    /// [`EvaluationError::NoMasks`], [`EvaluationError::NoTrajectories`] if a task's episodes are too short, or
    /// [`EvaluationError::NoMovingWindows`].
    pub fn choose(
        recordings: &Recordings,
        settings: &OpenLoopSettings,
    ) -> Result<Vec<Self>, EvaluationError> {
        if recordings.is_empty() {
            return Err(EvaluationError::NoMasks);
        }
        recordings.tasks().map(|(task, recordings)| Self::of(task, recordings, settings)).collect()
    }

    fn of(
        task: &str,
        recordings: &[Recording],
        settings: &OpenLoopSettings,
    ) -> Result<Self, EvaluationError> {
        let length = settings.context + settings.imagined;
        let starts: Vec<Vec<Trajectory>> = recordings
            .iter()
            .enumerate()
            .map(|(number, recording)| windows(recording, number, settings))
            .collect();
        let fitting: Vec<&Vec<Trajectory>> = starts.iter().filter(|windows| !windows.is_empty()).collect();
        let (task, episodes) = (task.to_owned(), recordings.len());
        match settings.windows {
            _ if !fitting.is_empty() => {
                let chosen = choose(&fitting, settings.trajectories, settings.seed);
                Ok(Self { task, length, chosen })
            }
            Windows::Anywhere => Err(EvaluationError::NoTrajectories { task, episodes, length }),
            Windows::Moving => {
                let least = settings.context + imagined_least(settings);
                Err(EvaluationError::NoMovingWindows { task, episodes, least })
            }
        }
    }

    /// One trajectory of at most `length` steps, from the first step of an episode that the seed draws, of those that
    /// succeeded where there are such: what comes before an object is touched is in it. None where no episode has two steps.
    #[must_use]
    pub fn whole(recordings: &Recordings, task: &str, length: usize, seed: u64) -> Option<Self> {
        let recordings = recordings.task(task);
        let longest = recordings.iter().map(|recording| recording.episode.len()).max()?.min(length);
        let fits = |episode: &Episode| longest > 1 && episode.len() >= longest;
        let fitting = || recordings.iter().enumerate().filter(|(_, recording)| fits(&recording.episode));
        let solved: Vec<_> = fitting().filter(|(_, recording)| recording.episode.succeeded()).collect();
        let from = if solved.is_empty() { fitting().collect() } else { solved };
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (number, recording) = from.get(random.random_range(0..from.len().max(1)))?;
        let trajectory = trajectory(recording, *number, 0..longest);
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
        distinct(self.numbers())
    }

    /// The kinds of script with their places among the trajectories.
    #[must_use]
    pub fn kinds(&self) -> BTreeMap<&'static str, Vec<usize>> {
        let mut kinds: BTreeMap<_, Vec<usize>> = BTreeMap::new();
        for (place, trajectory) in self.chosen.iter().enumerate() {
            kinds.entry(trajectory.kind).or_default().push(place);
        }
        kinds
    }

    /// What was chosen, in a line; `context` as in the settings.
    #[must_use]
    pub fn summary(&self, context: usize) -> String {
        let kinds = self.kinds().into_iter().map(|(kind, places)| {
            let episodes = distinct(places.iter().map(|place| self.chosen[*place].number).collect());
            format!("{kind} {} of {episodes}", places.len())
        });
        let imagined =
            || self.chosen.iter().map(|trajectory| trajectory.steps - context.min(trajectory.steps));
        format!(
            "{}: {} windows of {} episodes ({}), {} to {} imagined steps",
            self.task,
            self.chosen.len(),
            self.episodes(),
            kinds.collect::<Vec<_>>().join(", "),
            imagined().min().unwrap_or(0),
            imagined().max().unwrap_or(0)
        )
    }

    /// Trajectories `from` to `to` as a batch with masks. The last step of an episode is repeated where a shorter trajectory needs it.
    pub fn batch(&self, from: usize, to: usize, device: &Device) -> Result<Batch, EvaluationError> {
        let states = self.chosen.iter().all(|chosen| chosen.episode.proprio.is_some());
        let mut batch = HostBatch { rows: to - from, length: self.length, states, ..HostBatch::default() };
        for Trajectory { episode, start, .. } in &self.chosen[from..to] {
            let there = self.length.min(episode.len() - start);
            append_steps(&self.task, episode, *start, there, true, &mut batch)?;
            for _ in there..self.length {
                append_steps(&self.task, episode, episode.len() - 1, 1, true, &mut batch)?;
            }
        }
        Ok(batch.into_tensors(device)?)
    }
}

fn distinct(mut numbers: Vec<usize>) -> usize {
    numbers.sort_unstable();
    numbers.dedup();
    numbers.len()
}

fn imagined_least(settings: &OpenLoopSettings) -> usize {
    settings.imagined.min(IMAGINED_LEAST)
}

fn trajectory(recording: &Recording, number: usize, steps: Range<usize>) -> Trajectory {
    let (episode, kind) = (Arc::clone(&recording.episode), recording.kind);
    Trajectory { episode, number, kind, start: steps.start, steps: steps.len() }
}

/// All stretches of an episode that may be chosen, one a start.
fn windows(recording: &Recording, number: usize, settings: &OpenLoopSettings) -> Vec<Trajectory> {
    let (context, length) = (settings.context, settings.context + settings.imagined);
    let episode = &recording.episode;
    let of = |steps: Range<usize>| trajectory(recording, number, steps);
    match settings.windows {
        Windows::Anywhere => {
            let starts = 0..(episode.len() + 1).saturating_sub(length);
            starts.map(|start| of(start..start + length)).collect()
        }
        Windows::Moving => {
            let end = episode.success.iter().position(|solved| *solved).unwrap_or(episode.len());
            let starts = 0..(end + 1).saturating_sub(context + imagined_least(settings));
            let moves = robot_moves(episode);
            let fits = |steps: &Range<usize>| {
                let imagined = &moves[steps.start + context..steps.end];
                2 * imagined.iter().filter(|moves| **moves).count() >= imagined.len()
            };
            starts.map(|start| start..end.min(start + length)).filter(fits).map(of).collect()
        }
    }
}

/// Equally many of each episode's windows, as far as it has them.
fn choose(episodes: &[&Vec<Trajectory>], count: usize, seed: u64) -> Vec<Trajectory> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut order: Vec<usize> = (0..episodes.len()).collect();
    order.shuffle(&mut random);
    let mut chosen = Vec::with_capacity(count);
    for (turn, number) in order.iter().enumerate() {
        let share = count / order.len() + usize::from(turn < count % order.len());
        let windows = episodes[*number];
        let drawn = index::sample(&mut random, windows.len(), share.min(windows.len()));
        chosen.extend(drawn.into_iter().map(|start| windows[start].clone()));
    }
    // Neighbours are of different episodes: the first few, which films are made of, show more.
    chosen.shuffle(&mut random);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn masked(steps: usize) -> Episode {
        let robot_mask = Some(ndarray::Array3::from_elem((steps, 64, 64), false));
        Episode { robot_mask, ..Episode::blank(steps) }
    }

    /// A square, the robot, goes to and fro up to step `still`; the task is solved from `solved` on.
    fn moving(steps: usize, still: usize, solved: usize) -> Episode {
        let inside = |t: usize, y: usize, x: usize| {
            let left = 4 * (t.min(still) % 8);
            (10..20).contains(&y) && (left..left + 10).contains(&x)
        };
        Episode {
            image: ndarray::Array4::from_shape_fn((steps, 64, 64, 3), |(t, y, x, _)| {
                200 * u8::from(inside(t, y, x))
            }),
            robot_mask: Some(ndarray::Array3::from_shape_fn((steps, 64, 64), |(t, y, x)| inside(t, y, x))),
            success: (0..steps).map(|t| t >= solved).collect(),
            ..Episode::blank(steps)
        }
    }

    fn settings(windows: Windows) -> OpenLoopSettings {
        OpenLoopSettings { context: 5, imagined: 20, windows, ..OpenLoopSettings::default() }
    }

    #[test]
    fn a_whole_trajectory_begins_an_episode_that_was_solved() {
        let mut recordings = Recordings::default();
        for (steps, solved) in [(30, false), (20, true), (30, true), (5, true)] {
            let mut episode = masked(steps);
            episode.success[steps - 1] = solved;
            recordings.add("hammer", "expert", episode).unwrap();
        }
        for seed in 0..10 {
            let found = TaskTrajectories::whole(&recordings, "hammer", 25, seed).unwrap();
            assert_eq!((found.length, found.chosen[0].start, found.numbers()), (25, 0, vec![2]));
        }
        let longest = TaskTrajectories::whole(&recordings, "hammer", 99, 0).unwrap();
        assert_eq!(longest.length, 30, "as long as there are");
        assert!(TaskTrajectories::whole(&recordings, "reach", 25, 0).is_none());
    }

    #[test]
    fn windows_end_before_success_and_the_robot_moves_in_them() {
        let mut recordings = Recordings::default();
        recordings.add("hammer", "expert", moving(60, 60, 22)).unwrap(); // starts 0 to 2
        recordings.add("hammer", "mixed", moving(60, 30, 60)).unwrap(); // steps 31 to 59 hold still
        recordings.add("hammer", "random", moving(60, 0, 60)).unwrap(); // never moves
        let found = &TaskTrajectories::choose(&recordings, &settings(Windows::Moving)).unwrap()[0];
        let of = |kind: &str| {
            let mut found: Vec<_> =
                found.chosen.iter().filter(|t| t.kind == kind).map(|t| (t.start, t.steps)).collect();
            found.sort_unstable();
            found
        };
        assert_eq!(of("expert"), [(0, 22), (1, 21), (2, 20)]);
        // Steps start + 5 to start + 24 are imagined; ten of them must be step 30 or before.
        assert_eq!(of("mixed"), (0..=16).map(|start| (start, 25)).collect::<Vec<_>>());
        assert_eq!((of("random").len(), found.episodes()), (0, 2));
        let text = found.summary(5);
        assert_eq!(
            text,
            "hammer: 20 windows of 2 episodes (expert 3 of 1, mixed 17 of 1), 15 to 20 imagined steps"
        );
        let anywhere = &TaskTrajectories::choose(&recordings, &settings(Windows::Anywhere)).unwrap()[0];
        assert_eq!((anywhere.chosen.len(), anywhere.episodes()), (100, 3));
    }

    #[test]
    fn a_task_without_such_windows_is_one_clear_error() {
        let mut recordings = Recordings::default();
        recordings.add("hammer", "expert", moving(60, 60, 19)).unwrap();
        recordings.add("hammer", "random", moving(60, 3, 60)).unwrap();
        let error = TaskTrajectories::choose(&recordings, &settings(Windows::Moving)).unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("none of 2") && text.contains("20 steps") && text.contains("--windows anywhere"),
            "{text}"
        );
    }

    #[test]
    fn a_window_at_the_end_of_a_short_episode_is_filled_up() {
        let mut recordings = Recordings::default();
        recordings.add("hammer", "expert", moving(21, 60, 20)).unwrap();
        let found = &TaskTrajectories::choose(&recordings, &settings(Windows::Moving)).unwrap()[0];
        assert_eq!((found.chosen.len(), found.chosen[0].steps, found.length), (1, 20, 25));
        assert_eq!(found.batch(0, 1, &Device::Cpu).unwrap().image.dims(), [1, 25, 64, 64, 3]);
    }
}
