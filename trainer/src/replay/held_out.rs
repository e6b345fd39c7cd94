use super::store::{Replay, Task};

impl Replay {
    /// Takes `count` episodes of every task out, to judge a model by, but never more than half of a task's. They are spread over the
    /// order in which the episodes came, because those that came together are often of one kind. Episodes without masks go
    /// first: masks are few, and the warm-up needs them.
    #[must_use]
    pub fn hold_out(mut self, count: usize) -> (Self, Self) {
        let mut held_out = Self::new(self.capacity);
        for (name, task) in &mut self.tasks {
            let taken = task.take(count.min(task.episodes.len() / 2));
            self.steps -= taken.steps;
            held_out.steps += taken.steps;
            if !taken.episodes.is_empty() {
                held_out.tasks.insert(name.clone(), taken);
            }
        }
        (held_out.next_number, held_out.model) = (self.next_number, self.model.clone());
        (self, held_out)
    }
}

impl Task {
    fn take(&mut self, count: usize) -> Self {
        let is_masked = |index: &usize| self.episodes[*index].episode.robot_mask.is_some();
        let (masked, unmasked): (Vec<_>, Vec<_>) = (0..self.episodes.len()).partition(is_masked);
        let mut order = spread(&unmasked, count);
        order.extend(spread(&masked, count - order.len()));
        let (mut taken, mut kept) = (Self::default(), Self::default());
        for (index, stored) in std::mem::take(&mut self.episodes).into_iter().enumerate() {
            let home = if order.contains(&index) { &mut taken } else { &mut kept };
            home.steps += stored.episode.len();
            home.episodes.push_back(stored);
        }
        *self = kept;
        taken
    }
}

/// `count` of the entries, or all there are, at even distances.
fn spread(entries: &[usize], count: usize) -> Vec<usize> {
    let count = count.min(entries.len());
    (0..count).map(|index| entries[(2 * index + 1) * entries.len() / (2 * count)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array1, Array3};
    use rcwm_models::episode::Episode;

    fn episode(reward: f32, masked: bool) -> Episode {
        Episode {
            reward: Array1::from_elem(3, reward),
            robot_mask: masked.then(|| Array3::from_elem((3, 64, 64), true)),
            ..Episode::blank(3)
        }
    }

    fn rewards(replay: &Replay) -> Vec<(String, Vec<f32>)> {
        let of = |(name, episodes): (&str, Vec<&std::sync::Arc<Episode>>)| {
            (name.to_owned(), episodes.iter().map(|episode| episode.reward[0]).collect())
        };
        replay.tasks().map(of).collect()
    }

    #[test]
    fn those_without_masks_are_held_out_first_and_never_more_than_half() {
        let mut replay = Replay::new(1000);
        for (task, reward, masked) in [
            ("a", 1.0, false),
            ("a", 2.0, false),
            ("a", 3.0, false),
            ("a", 4.0, true),
            ("b", 5.0, true),
            ("b", 6.0, true),
            ("c", 7.0, false),
        ] {
            replay.add(task, episode(reward, masked)).unwrap();
        }
        let (kept, held_out) = replay.hold_out(2);
        let named = |name: &str, rewards: &[f32]| (name.to_owned(), rewards.to_vec());
        assert_eq!(rewards(&held_out), [named("a", &[1.0, 3.0]), named("b", &[6.0])]);
        assert_eq!(rewards(&kept), [named("a", &[2.0, 4.0]), named("b", &[5.0]), named("c", &[7.0])]);
        assert_eq!((kept.steps(), held_out.steps()), (12, 9));
        assert_eq!(kept.masked().episodes(), 2);
    }

    #[test]
    fn what_is_held_out_is_spread_over_all_that_came() {
        let entries: Vec<usize> = (100..200).collect();
        assert_eq!(spread(&entries, 2), [125, 175]);
        assert_eq!(spread(&entries, 4), [112, 137, 162, 187]);
        assert_eq!(spread(&entries[..2], 5), [100, 101]);
    }

    #[test]
    fn nothing_is_held_out_where_nothing_is_asked_for() {
        let mut replay = Replay::new(100);
        replay.add("a", episode(1.0, false)).unwrap();
        replay.add("a", episode(2.0, false)).unwrap();
        let (kept, held_out) = replay.hold_out(0);
        assert_eq!((kept.episodes(), held_out.episodes()), (2, 0));
    }
}
