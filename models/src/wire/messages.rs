//! The headers of the two messages. Their type names carry a version: a peer of another version is refused when it connects. What
//! follows a header is laid out by the interface ([`crate::interface::Layout`]).

use iceoryx2::prelude::ZeroCopySend;

pub use crate::interface::CAMERAS_MAX;

/// Version of the messages.
pub const WIRE: u32 = 2;

/// Facts about an observation, as bits of [`ObservationHeader::flags`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ObservationFlags(pub u32);

impl ObservationFlags {
    /// First of its episode: there is no action that led to it.
    pub const FIRST: Self = Self(1);
    /// Last of its episode; the next observation is a [`Self::FIRST`].
    pub const LAST: Self = Self(1 << 1);
    /// The episode ended because the task did, not because its time was up.
    pub const TERMINAL: Self = Self(1 << 2);
    /// The task counts as solved in this state.
    pub const SUCCESS: Self = Self(1 << 3);
    /// The masks of all cameras that have one are there.
    pub const MASK_VALID: Self = Self(1 << 4);
    /// No answer had come in time: the executed action is the previous one, held, or rest where nobody steers any more.
    pub const ACTION_HELD: Self = Self(1 << 5);
    /// The same observation (same sequence) was published before; it is sent again for a new or silent controller.
    pub const REPEATED: Self = Self(1 << 6);
    /// The executed action was a push off course, made to show how to recover: no example of what to do.
    pub const PUSHED: Self = Self(1 << 7);

    /// Whether all bits of `other` are set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// The names of all that are set.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        let all = [
            (Self::FIRST, "first"),
            (Self::LAST, "last"),
            (Self::TERMINAL, "terminal"),
            (Self::SUCCESS, "success"),
            (Self::MASK_VALID, "mask"),
            (Self::ACTION_HELD, "held"),
            (Self::REPEATED, "repeated"),
            (Self::PUSHED, "pushed"),
        ];
        all.into_iter().filter(move |(flag, _)| self.contains(*flag)).map(|(_, name)| name)
    }

    /// These bits, with those of `other` set when `condition` holds.
    #[must_use]
    pub const fn with(self, other: Self, condition: bool) -> Self {
        if condition { Self(self.0 | other.0) } else { self }
    }
}

/// What stands before the numbers and pictures of an observation. All times are CLOCK_MONOTONIC in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("rcwm.Observation.v2")]
#[repr(C)]
pub struct ObservationHeader {
    /// Counts up by one with every new observation of this publisher, from 0.
    pub sequence: u64,
    /// Counts episodes, from 0.
    pub episode: u64,
    /// When this observation was due; equals `published_ns` in lock-step.
    pub scheduled_ns: u64,
    /// When it was published.
    pub published_ns: u64,
    /// The control period in real time; 0 in lock-step, where the publisher waits for each answer.
    pub period_ns: u64,
    /// When each camera took its picture, in the interface's order; 0 where that is not known.
    pub captured_ns: [u64; CAMERAS_MAX],
    /// Observations since the first of the episode.
    pub step: u32,
    /// See [`ObservationFlags`].
    pub flags: u32,
    /// Number of the task ([`crate::tasks::TASKS`]), or [`crate::tasks::OWN_TASK`].
    pub task: u32,
    /// Reward of the transition that led here; 0 at the first of an episode.
    pub reward: f32,
}

impl ObservationHeader {
    #[must_use]
    pub const fn zeroed() -> Self {
        Self {
            sequence: 0,
            episode: 0,
            scheduled_ns: 0,
            published_ns: 0,
            period_ns: 0,
            captured_ns: [0; CAMERAS_MAX],
            step: 0,
            flags: 0,
            task: crate::tasks::OWN_TASK,
            reward: 0.0,
        }
    }

    /// Whether the flag is set.
    #[must_use]
    pub const fn is(&self, flag: ObservationFlags) -> bool {
        ObservationFlags(self.flags).contains(flag)
    }
}

impl Default for ObservationHeader {
    fn default() -> Self {
        Self::zeroed()
    }
}

/// What stands before the numbers of an action.
#[derive(Debug, Clone, Copy, Default, PartialEq, ZeroCopySend)]
#[type_name("rcwm.Action.v2")]
#[repr(C)]
pub struct ActionHeader {
    /// Sequence of the observation it answers.
    pub answers: u64,
    /// When it was published, CLOCK_MONOTONIC in nanoseconds.
    pub published_ns: u64,
    /// See [`super::ActionSource`].
    pub source: u32,
    /// Always 0; keeps the layout free of hidden padding.
    pub reserved: u32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::{offset_of, size_of};

    /// Peers in Python and C are written against these numbers.
    #[test]
    fn the_layout_is_the_published_one() {
        assert_eq!(offset_of!(ObservationHeader, captured_ns), 40);
        assert_eq!(offset_of!(ObservationHeader, step), 104);
        assert_eq!(offset_of!(ObservationHeader, reward), 116);
        assert_eq!(size_of::<ObservationHeader>(), 120);
        assert_eq!(offset_of!(ActionHeader, source), 16);
        assert_eq!(size_of::<ActionHeader>(), 24);
    }

    #[test]
    fn flags_set_and_read_one_by_one() {
        let flags = ObservationFlags::default()
            .with(ObservationFlags::LAST, true)
            .with(ObservationFlags::FIRST, false);
        assert!(flags.contains(ObservationFlags::LAST) && !flags.contains(ObservationFlags::FIRST));
        assert_eq!(
            flags.with(ObservationFlags::PUSHED, true).names().collect::<Vec<_>>(),
            ["last", "pushed"]
        );
    }
}
