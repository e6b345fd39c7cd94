//! The policy's states before the ticks that were imagined since the last observation.

use crate::policy::State;

/// States for which there is memory from the beginning: more than are usually imagined in a row.
const READY: u32 = 64;

/// One state a tick; their memory is used again and again.
pub(super) struct Imagined {
    before: Vec<(u64, State)>,
    count: usize,
}

impl Imagined {
    /// None so far; memory for states like this one is there.
    pub(super) fn new(ticks_max: u32, like: &State) -> Self {
        Self { before: vec![(0, like.clone()); ticks_max.min(READY) as usize], count: 0 }
    }

    /// Notes the state before the tick that stands in for the observation of this sequence.
    pub(super) fn note(&mut self, sequence: u64, state: &State) {
        match self.before.get_mut(self.count) {
            Some((place, before)) => {
                *place = sequence;
                before.clone_from(state);
            }
            None => self.before.push((sequence, state.clone())),
        }
        self.count += 1;
    }

    /// The tick noted last has failed.
    pub(super) fn take_back(&mut self) {
        self.count = self.count.saturating_sub(1);
    }

    /// The state before the first imagined tick of this sequence or a later one.
    pub(super) fn before(&self, sequence: u64) -> Option<&State> {
        let noted = &self.before[..self.count];
        noted.iter().find(|(imagined, _)| *imagined >= sequence).map(|(_, state)| state)
    }

    pub(super) fn clear(&mut self) {
        self.count = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::BranchState;

    fn state(h: f32) -> State {
        let branch = || BranchState { z: vec![1; 4], h: vec![h; 8] };
        State { branches: vec![branch(), branch()] }
    }

    #[test]
    fn the_state_before_a_tick_is_found_and_its_memory_is_used_again() {
        let mut imagined = Imagined::new(2, &state(0.0));
        let places = |imagined: &Imagined| -> Vec<_> {
            imagined.before.iter().map(|(_, state)| state.branches[0].h.as_ptr()).collect()
        };
        let ready = places(&imagined);
        for round in 0..5 {
            imagined.note(10, &state(1.0));
            imagined.note(11, &state(2.0));
            assert_eq!(imagined.before(9), Some(&state(1.0)), "round {round}");
            assert_eq!(imagined.before(11), Some(&state(2.0)));
            assert_eq!(imagined.before(12), None);
            imagined.take_back();
            assert_eq!(imagined.before(11), None);
            imagined.clear();
            assert_eq!(imagined.before(0), None);
        }
        assert_eq!(places(&imagined), ready);
        // More than there was memory for are kept all the same.
        (0..5).for_each(|sequence| imagined.note(sequence, &state(sequence as f32)));
        assert_eq!(imagined.before(4), Some(&state(4.0)));
    }
}
