use std::sync::{Arc, PoisonError, RwLock};

use rcwm_models::episode::Episode;

use super::{Replay, ReplayError};
use crate::learning::HostBatch;

/// A replay that one thread adds to while another draws from it. What batch `number` holds then depends on what had arrived when it
/// was drawn; batches that were drawn ahead do not know what came since.
#[derive(Debug, Clone)]
pub struct SharedReplay(Arc<RwLock<Replay>>);

impl SharedReplay {
    /// Shares a replay.
    #[must_use]
    pub fn new(replay: Replay) -> Self {
        Self(Arc::new(RwLock::new(replay)))
    }

    /// See [`Replay::add`].
    pub fn add(&self, task: &str, episode: impl Into<Arc<Episode>>) -> Result<(), ReplayError> {
        // Every change of a replay is whole before anything in it can panic: one that was poisoned is usable.
        self.0.write().unwrap_or_else(PoisonError::into_inner).add(task, episode)
    }

    /// See [`Replay::draw`].
    pub fn draw(
        &self,
        rows: usize,
        length: usize,
        masks: bool,
        seed: u64,
        number: u64,
    ) -> Result<HostBatch, ReplayError> {
        self.read(|replay| replay.draw(rows, length, masks, seed, number))
    }

    /// Steps held.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.read(Replay::steps)
    }

    /// Episodes held.
    #[must_use]
    pub fn episodes(&self) -> usize {
        self.read(Replay::episodes)
    }

    fn read<T>(&self, look: impl FnOnce(&Replay) -> T) -> T {
        look(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::Prefetch;
    use ndarray::Array1;

    fn episode(reward: f32) -> Episode {
        Episode { reward: Array1::from_elem(8, reward), ..Episode::blank(8) }
    }

    #[test]
    fn batches_drawn_on_another_thread_hold_what_has_arrived() {
        let replay = SharedReplay::new(Replay::new(100));
        replay.add("reach", episode(1.0)).unwrap();
        let source = replay.clone();
        let mut batches = Prefetch::start(0, 1, move |number| source.draw(4, 2, false, 0, number)).unwrap();
        assert!(batches.next_batch().unwrap().reward.iter().all(|reward| *reward == 1.0));
        replay.add("reach", episode(2.0)).unwrap();
        assert_eq!((replay.steps(), replay.episodes()), (16, 2));
        let mut drawn = (0..20).flat_map(|_| batches.next_batch().unwrap().reward);
        assert!(drawn.any(|reward| reward == 2.0), "the new episode is drawn too");
    }
}
