//! What an observation is to the ones before it.

/// How an observation stands to those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrival {
    /// The first ever, or the first of another publisher.
    Joined {
        /// Another publisher was heard before.
        restarted: bool,
    },
    /// A later one than the last.
    Next {
        /// Observations in between that never arrived.
        missed: u64,
        /// It belongs to another episode than the last.
        new_episode: bool,
    },
    /// The last one again.
    Repeated,
    /// An older one than the last, of the same publisher.
    Stale,
}

impl Arrival {
    /// Whether the observation has not been seen, and is later than those that have.
    #[must_use]
    pub fn is_new(self) -> bool {
        matches!(self, Self::Joined { .. } | Self::Next { .. })
    }
}

/// Publisher, sequence and episode of the last observation.
#[derive(Debug, Clone, Copy, Default)]
pub struct SequenceTracker {
    last: Option<Seen>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Seen {
    publisher: u128,
    sequence: u64,
    episode: u64,
}

impl SequenceTracker {
    /// How an observation stands to the last one.
    #[must_use]
    pub fn look(&self, publisher: u128, sequence: u64, episode: u64) -> Arrival {
        match self.last {
            None => Arrival::Joined { restarted: false },
            // Sequences of two publishers do not compare: a simulator that was started again counts from 0.
            Some(last) if last.publisher != publisher => Arrival::Joined { restarted: true },
            Some(last) if last.sequence == sequence => Arrival::Repeated,
            Some(last) if last.sequence > sequence => Arrival::Stale,
            Some(last) => {
                Arrival::Next { missed: sequence - last.sequence - 1, new_episode: last.episode != episode }
            }
        }
    }

    /// Places an observation, and remembers it unless it is repeated or stale.
    pub fn place(&mut self, publisher: u128, sequence: u64, episode: u64) -> Arrival {
        let arrival = self.look(publisher, sequence, episode);
        if arrival.is_new() {
            self.last = Some(Seen { publisher, sequence, episode });
        }
        arrival
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn observations_in_order_follow_one_another_and_gaps_are_counted() {
        let mut tracker = SequenceTracker::default();
        assert_eq!(tracker.place(1, 5, 0), Arrival::Joined { restarted: false });
        assert_eq!(tracker.place(1, 6, 0), Arrival::Next { missed: 0, new_episode: false });
        assert_eq!(tracker.place(1, 9, 1), Arrival::Next { missed: 2, new_episode: true });
    }

    #[test]
    fn repeated_and_stale_ones_change_nothing() {
        let mut tracker = SequenceTracker::default();
        tracker.place(1, 7, 0);
        assert_eq!(tracker.place(1, 7, 0), Arrival::Repeated);
        assert_eq!(tracker.place(1, 3, 0), Arrival::Stale);
        assert_eq!(tracker.place(1, 8, 0), Arrival::Next { missed: 0, new_episode: false });
    }

    #[test]
    fn another_publisher_is_a_restart_whatever_its_sequence() {
        let mut tracker = SequenceTracker::default();
        tracker.place(1, 0, 0);
        assert_eq!(tracker.place(2, 0, 0), Arrival::Joined { restarted: true });
        assert_eq!(tracker.place(2, 1, 0), Arrival::Next { missed: 0, new_episode: false });
    }
}
