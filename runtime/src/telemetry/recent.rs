//! The last recordings one by one, for who looks on once a tick.

use super::Stage;

/// Recordings that are remembered: those of a tick after a long stall, which counts for each that it made late.
pub const RECENT_MAX: usize = 2048;

#[derive(Clone)]
pub(super) struct Recent {
    entries: Box<[(Stage, u64)]>,
    noted: u64,
}

impl Recent {
    pub(super) fn new() -> Self {
        Self { entries: vec![(Stage::Tick, 0); RECENT_MAX].into(), noted: 0 }
    }

    pub(super) fn note(&mut self, stage: Stage, time_ns: u64) {
        self.entries[(self.noted % RECENT_MAX as u64) as usize] = (stage, time_ns);
        self.noted += 1;
    }

    pub(super) fn noted(&self) -> u64 {
        self.noted
    }

    /// The recordings from number `first` on, as far as they are still remembered.
    pub(super) fn since(&self, first: u64) -> impl Iterator<Item = (Stage, u64)> {
        let remembered = self.noted.saturating_sub(RECENT_MAX as u64);
        (first.max(remembered)..self.noted).map(|number| self.entries[(number % RECENT_MAX as u64) as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_are_remembered_in_order_up_to_a_limit() {
        let mut recent = Recent::new();
        for time_ns in 0..RECENT_MAX as u64 + 6 {
            recent.note(Stage::Actor, time_ns);
        }
        assert_eq!(
            recent.since(RECENT_MAX as u64 + 4).collect::<Vec<_>>(),
            [2052, 2053].map(|time_ns| (Stage::Actor, time_ns))
        );
        assert_eq!((recent.since(0).count(), recent.since(0).next()), (RECENT_MAX, Some((Stage::Actor, 6))));
    }
}
