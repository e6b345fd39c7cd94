//! The episodes of a run: counts of all of them, and the last ones. A run may go on for months.

use std::collections::VecDeque;

use super::EpisodeResult;

/// Episodes that are kept one by one.
pub const EPISODES_KEPT: usize = 1000;

/// Episodes that are over, cut ones included.
#[derive(Debug, Clone, PartialEq)]
pub struct Episodes {
    last: VecDeque<EpisodeResult>,
    ended: u64,
    whole: u64,
    successes: u64,
    return_sum: f64,
}

impl Default for Episodes {
    /// None so far; memory for all that are kept is there.
    fn default() -> Self {
        Self {
            last: VecDeque::with_capacity(EPISODES_KEPT),
            ended: 0,
            whole: 0,
            successes: 0,
            return_sum: 0.0,
        }
    }
}

impl Episodes {
    pub(super) fn push(&mut self, episode: EpisodeResult) {
        self.ended += 1;
        if episode.whole {
            self.whole += 1;
            self.successes += u64::from(episode.success);
            self.return_sum += episode.return_sum;
        }
        if self.last.len() == EPISODES_KEPT {
            self.last.pop_front();
        }
        self.last.push_back(episode);
    }

    /// How many are over.
    #[must_use]
    pub fn ended(&self) -> u64 {
        self.ended
    }

    /// Those of them that were seen from first to last.
    #[must_use]
    pub fn whole(&self) -> u64 {
        self.whole
    }

    /// Those of the whole ones that were successful.
    #[must_use]
    pub fn successes(&self) -> u64 {
        self.successes
    }

    /// Mean return of the whole ones.
    #[must_use]
    pub fn return_mean(&self) -> Option<f64> {
        (self.whole > 0).then(|| self.return_sum / self.whole as f64)
    }

    /// Those from number `first` on, as far as they are kept: the last [`EPISODES_KEPT`].
    pub fn since(&self, first: u64) -> impl Iterator<Item = &EpisodeResult> {
        let kept_from = self.ended - self.last.len() as u64;
        self.last.iter().skip(usize::try_from(first.saturating_sub(kept_from)).unwrap_or(usize::MAX))
    }
}

#[cfg(test)]
mod tests {
    use rcwm_models::wire::ObservationHeader;

    use super::*;

    #[test]
    fn all_are_counted_the_last_are_kept_and_memory_stays() {
        let mut episodes = Episodes::default();
        let capacity = episodes.last.capacity();
        let count = 3 * EPISODES_KEPT as u64;
        for number in 0..count {
            let start = EpisodeResult::start(&ObservationHeader::zeroed());
            let (whole, success) = (number % 2 == 0, number % 4 == 0);
            episodes.push(EpisodeResult { episode: number, return_sum: 2.0, whole, success, ..start });
        }
        assert_eq!((episodes.ended(), episodes.whole(), episodes.successes()), (count, count / 2, count / 4));
        assert_eq!((episodes.return_mean(), episodes.last.capacity()), (Some(2.0), capacity));
        let numbers = |first| episodes.since(first).map(|episode| episode.episode).collect::<Vec<_>>();
        assert_eq!(numbers(count - 2), [count - 2, count - 1]);
        assert_eq!((numbers(0).len(), numbers(0)[0]), (EPISODES_KEPT, count - EPISODES_KEPT as u64));
        assert!(numbers(count).is_empty());
    }
}
