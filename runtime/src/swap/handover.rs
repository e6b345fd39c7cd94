//! The one place where two threads meet: the server puts a policy, the controller exchanges it for its own.

use std::sync::atomic::{AtomicI32, AtomicU8, Ordering};
use std::sync::{Mutex, PoisonError};

use super::When;
use crate::policy::Policy;

/// Where the controller is when it looks in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// Between two ticks of an episode.
    InEpisode,
    /// The next observation starts an episode, or none is running.
    BetweenEpisodes,
}

const EMPTY: u8 = 0;
const READY_FOR_EPISODE: u8 = 1;
const READY_NOW: u8 = 2;
const TAKEN: u8 = 3;

/// `T` is a policy.
pub(super) struct Handover<T = Policy> {
    state: AtomicU8,
    /// The server's policy, then the controller's old one. The server holds the lock for moments, and never while it works.
    place: Mutex<Option<T>>,
    /// The controller's thread, once it has looked in; else 0.
    ticking: AtomicI32,
}

impl<T> Default for Handover<T> {
    fn default() -> Self {
        Self { state: AtomicU8::new(EMPTY), place: Mutex::new(None), ticking: AtomicI32::new(0) }
    }
}

impl<T> Handover<T> {
    /// Server: lays a policy out.
    pub(super) fn put(&self, policy: T, when: When) {
        let ready = match when {
            When::Episode => READY_FOR_EPISODE,
            When::Now => READY_NOW,
        };
        *self.place.lock().unwrap_or_else(PoisonError::into_inner) = Some(policy);
        self.state.store(ready, Ordering::Release);
    }

    /// Server: the thread that ticks, once it has looked in.
    pub(super) fn ticking(&self) -> Option<i32> {
        Some(self.ticking.load(Ordering::Relaxed)).filter(|thread| *thread != 0)
    }

    /// Server: the controller's old policy, once it has taken the new one.
    pub(super) fn old(&self) -> Option<T> {
        if self.state.load(Ordering::Acquire) != TAKEN {
            return None;
        }
        self.clear()
    }

    /// Server: takes the policy back. What comes back is the new one, or, if the controller was faster, its old one: then the
    /// second value is true.
    pub(super) fn withdraw(&self) -> (Option<T>, bool) {
        let mut place = self.place.lock().unwrap_or_else(PoisonError::into_inner);
        // Under the lock the controller cannot be in the middle of an exchange.
        let taken = self.state.swap(EMPTY, Ordering::AcqRel) == TAKEN;
        (place.take(), taken)
    }

    fn clear(&self) -> Option<T> {
        let policy = self.place.lock().unwrap_or_else(PoisonError::into_inner).take();
        self.state.store(EMPTY, Ordering::Release);
        policy
    }

    /// Controller: see [`super::Swapper::poll`]. Never waits: where the server has the lock, the next tick looks again.
    pub(super) fn exchange(&self, moment: Moment, policy: &mut T) -> bool {
        self.ticking.store(rustix::thread::gettid().as_raw_nonzero().get(), Ordering::Relaxed);
        let wanted = match self.state.load(Ordering::Acquire) {
            READY_NOW => true,
            READY_FOR_EPISODE => moment == Moment::BetweenEpisodes,
            _ => false,
        };
        if !wanted {
            return false;
        }
        let Ok(mut place) = self.place.try_lock() else { return false };
        // Withdrawn since.
        let Some(new) = place.as_mut() else { return false };
        std::mem::swap(policy, new);
        self.state.store(TAKEN, Ordering::Release);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_policy_for_the_next_episode_waits_for_it_and_the_old_one_comes_back() {
        let handover = Handover::default();
        let mut running = "old";
        assert!(!handover.exchange(Moment::BetweenEpisodes, &mut running));
        handover.put("new", When::Episode);
        assert!(!handover.exchange(Moment::InEpisode, &mut running));
        assert_eq!(handover.old(), None);
        assert!(handover.exchange(Moment::BetweenEpisodes, &mut running));
        assert_eq!(running, "new");
        assert!(!handover.exchange(Moment::BetweenEpisodes, &mut running), "once");
        assert_eq!((handover.old(), handover.old()), (Some("old"), None));
    }

    #[test]
    fn a_policy_that_is_withdrawn_is_not_taken_and_one_that_was_taken_is_told_apart() {
        let handover = Handover::default();
        let mut running = "old";
        handover.put("new", When::Now);
        assert_eq!(handover.withdraw(), (Some("new"), false));
        assert!(!handover.exchange(Moment::InEpisode, &mut running));
        handover.put("newer", When::Now);
        assert!(handover.exchange(Moment::InEpisode, &mut running));
        assert_eq!(handover.withdraw(), (Some("old"), true));
    }

    #[test]
    fn the_controller_does_not_wait_for_the_server() {
        let handover = Handover::default();
        let mut running = "old";
        handover.put("new", When::Now);
        let busy = handover.place.lock().unwrap();
        assert!(!handover.exchange(Moment::InEpisode, &mut running));
        drop(busy);
        assert!(handover.exchange(Moment::InEpisode, &mut running));
    }
}
