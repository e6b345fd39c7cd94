//! The two messages. Their type names carry a version: a peer of another version is refused when it connects.

use iceoryx2::prelude::ZeroCopySend;

use crate::{ACTION_LEN, IMAGE_BYTES, MASK_BYTES, PROPRIOCEPTION_LEN};

/// Largest value of any component of an action, either way.
pub const ACTION_MAX: f32 = 1.0;
/// How far beyond [`ACTION_MAX`] a robot may report what it executed: it may have rounded.
const ACTION_ROUNDING: f32 = 1e-3;

/// Facts about an observation, as bits of [`Observation::flags`].
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
    /// [`Observation::robot_mask`] holds a mask.
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

    /// These bits, with those of `other` set when `condition` holds.
    #[must_use]
    pub const fn with(self, other: Self, condition: bool) -> Self {
        if condition { Self(self.0 | other.0) } else { self }
    }
}

/// What a simulator or a robot saw, and what it had done to get there.
///
/// Images are upright, rows first, channels last (RGB). All times are CLOCK_MONOTONIC in nanoseconds.
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("rcwm.Observation.v1")]
#[repr(C)]
pub struct Observation {
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
    /// Observations since the first of the episode.
    pub step: u32,
    /// See [`ObservationFlags`].
    pub flags: u32,
    /// Number of the task ([`crate::tasks::TASKS`]), or [`crate::tasks::OWN_TASK`].
    pub task: u32,
    /// Reward of the transition that led here; 0 at the first of an episode.
    pub reward: f32,
    /// The action that led here, as executed; each in [-1, 1]. At the first of an episode zeros, or, where actions are absolute
    /// positions, the one that the robot holds.
    pub executed_action: [f32; ACTION_LEN],
    /// 9 normalised joint positions, then 9 joint velocities.
    pub proprioception: [f32; PROPRIOCEPTION_LEN],
    /// 64 x 64 x 3.
    pub image: [u8; IMAGE_BYTES],
    /// 64 x 64: 255 where the robot is, else 0; meaningless without [`ObservationFlags::MASK_VALID`].
    pub robot_mask: [u8; MASK_BYTES],
}

impl Observation {
    /// An observation of zeros.
    #[must_use]
    pub const fn zeroed() -> Self {
        Self {
            sequence: 0,
            episode: 0,
            scheduled_ns: 0,
            published_ns: 0,
            period_ns: 0,
            step: 0,
            flags: 0,
            task: crate::tasks::OWN_TASK,
            reward: 0.0,
            executed_action: [0.0; ACTION_LEN],
            proprioception: [0.0; PROPRIOCEPTION_LEN],
            image: [0; IMAGE_BYTES],
            robot_mask: [0; MASK_BYTES],
        }
    }

    /// Whether the flag is set.
    #[must_use]
    pub const fn is(&self, flag: ObservationFlags) -> bool {
        ObservationFlags(self.flags).contains(flag)
    }

    /// Whether the executed action is one that a robot can have executed: every component finite and, but for rounding, in [-1, 1].
    #[must_use]
    pub fn has_executable_action(&self) -> bool {
        // NaN is not less than anything.
        self.executed_action.iter().all(|x| x.abs() <= ACTION_MAX + ACTION_ROUNDING)
    }

    /// Whether every number in it is finite and the executed action in range; nothing else may reach a policy.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.is_finite() && self.has_executable_action()
    }

    /// Whether every number in it is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.reward.is_finite()
            && self.executed_action.iter().all(|x| x.is_finite())
            && self.proprioception.iter().all(|x| x.is_finite())
    }
}

/// Where an action came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum ActionSource {
    /// The policy, on the observation it answers.
    Policy = 0,
    /// The policy, on a state the world model imagined because the observation was missing.
    Imagined = 1,
    /// The configured fallback: the policy had nothing fit to send.
    Fallback = 2,
}

impl ActionSource {
    /// The source of a wire number, if it is one.
    #[must_use]
    pub const fn from_wire(number: u32) -> Option<Self> {
        match number {
            0 => Some(Self::Policy),
            1 => Some(Self::Imagined),
            2 => Some(Self::Fallback),
            _ => None,
        }
    }
}

/// A controller's answer to one observation.
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("rcwm.Action.v1")]
#[repr(C)]
pub struct Action {
    /// Sequence of the observation it answers.
    pub answers: u64,
    /// When it was published, CLOCK_MONOTONIC in nanoseconds.
    pub published_ns: u64,
    /// See [`ActionSource`].
    pub source: u32,
    /// Always 0; keeps the layout free of hidden padding.
    pub reserved: u32,
    /// Each in [-1, 1].
    pub action: [f32; ACTION_LEN],
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::{offset_of, size_of};

    /// Peers in Python and C are written against these numbers.
    #[test]
    fn the_layout_is_the_published_one() {
        assert_eq!(offset_of!(Observation, step), 40);
        assert_eq!(offset_of!(Observation, executed_action), 56);
        assert_eq!(offset_of!(Observation, proprioception), 72);
        assert_eq!(offset_of!(Observation, image), 144);
        assert_eq!(offset_of!(Observation, robot_mask), 144 + IMAGE_BYTES);
        assert_eq!(size_of::<Observation>(), 144 + IMAGE_BYTES + MASK_BYTES);
        assert_eq!(offset_of!(Action, action), 24);
        assert_eq!(size_of::<Action>(), 40);
    }

    #[test]
    fn flags_set_and_read_one_by_one() {
        let flags = ObservationFlags::default()
            .with(ObservationFlags::LAST, true)
            .with(ObservationFlags::FIRST, false);
        assert!(flags.contains(ObservationFlags::LAST) && !flags.contains(ObservationFlags::FIRST));
    }

    #[test]
    fn a_non_finite_observation_is_seen() {
        let mut observation = Observation::zeroed();
        assert!(observation.is_finite());
        observation.proprioception[17] = f32::NAN;
        assert!(!observation.is_finite() && !observation.is_valid());
    }

    #[test]
    fn an_executed_action_out_of_range_makes_an_observation_invalid() {
        let mut observation = Observation::zeroed();
        for (executed, valid) in
            [(-1.0, true), (1.0 + f32::EPSILON, true), (1.1, false), (-3e38, false), (f32::NAN, false)]
        {
            observation.executed_action[2] = executed;
            assert_eq!(observation.is_valid(), valid, "{executed}");
        }
    }
}
