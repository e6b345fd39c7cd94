//! The policy's last calls, so that a log can hold them and a replay can make them again: whoever asked, in whatever order.

use std::sync::atomic::{AtomicU64, Ordering};

use rcwm_models::bundle::PartName;
use rcwm_models::wire::ActionValues;
use serde::{Deserialize, Serialize};

use super::{Decision, PolicyError, STAGES, Surprise};

/// Calls that are remembered: far more than happen between two ticks.
pub const CALLS_MAX: usize = 32;

/// What was asked of the policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum CallKind {
    /// [`super::Policy::work_ahead`].
    WorkAhead,
    /// [`super::Policy::observe`].
    Observe,
    /// [`super::Policy::imagine`].
    Imagine,
    /// [`super::Policy::set_state`].
    SetState,
}

/// How a call ended.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "copied by a loop that must not allocate")]
pub enum CallOutcome {
    /// Work ahead was done.
    Done {
        /// How long it took, in ns.
        time_ns: u64,
    },
    /// The state with this checksum was taken over.
    StateSet {
        /// See [`super::State::checksum`].
        checksum: u32,
    },
    /// A decision was made.
    Decided {
        /// The action, within the bundle's limits.
        action: ActionValues,
        /// Work ahead was for another action and was done again.
        recomputed: bool,
        /// How unexpected the image was.
        surprise: Option<Surprise>,
        /// Time in each of [`STAGES`], in ns.
        stage_ns: [u64; STAGES.len()],
    },
    /// A part gave something that is not finite, or a class that does not exist.
    NotFinite {
        part: PartName,
    },
    /// What was handed over was refused.
    Refused,
    EngineFailed,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Call {
    /// What was asked.
    pub kind: CallKind,
    /// The action it was about; none at an episode's start.
    pub action: Option<ActionValues>,
    /// How it ended.
    pub outcome: CallOutcome,
}

impl From<&Result<Decision, PolicyError>> for CallOutcome {
    fn from(result: &Result<Decision, PolicyError>) -> Self {
        match result {
            Ok(Decision { action, recomputed, surprise, stage_ns, .. }) => Self::Decided {
                action: *action,
                recomputed: *recomputed,
                surprise: *surprise,
                stage_ns: *stage_ns,
            },
            Err(error) => Self::failed(error),
        }
    }
}

impl CallOutcome {
    pub(super) fn of_work_ahead(result: &Result<(), PolicyError>, time_ns: u64) -> Self {
        result.as_ref().map_or_else(Self::failed, |()| Self::Done { time_ns })
    }

    fn failed(error: &PolicyError) -> Self {
        match error {
            PolicyError::NotFinite { part, .. } => Self::NotFinite { part: *part },
            PolicyError::Observation(_) => Self::Refused,
            PolicyError::Engine(_)
            | PolicyError::Bundle(_)
            | PolicyError::Compile(_)
            | PolicyError::NothingToSample
            | PolicyError::Thread(_) => Self::EngineFailed,
        }
    }
}

/// The last [`CALLS_MAX`] calls, in a ring that never grows.
#[derive(Debug, Clone)]
pub(super) struct CallRing {
    policy: u64,
    calls: Box<[Call]>,
    made: u64,
}

impl CallRing {
    pub(super) fn new() -> Self {
        static POLICIES: AtomicU64 = AtomicU64::new(0);
        let none = Call { kind: CallKind::WorkAhead, action: None, outcome: CallOutcome::Refused };
        Self {
            policy: POLICIES.fetch_add(1, Ordering::Relaxed),
            calls: vec![none; CALLS_MAX].into(),
            made: 0,
        }
    }

    pub(super) fn note(&mut self, kind: CallKind, action: Option<&ActionValues>, outcome: CallOutcome) {
        self.calls[(self.made % CALLS_MAX as u64) as usize] = Call { kind, action: action.copied(), outcome };
        self.made += 1;
    }

    /// A number that no other policy of this process has.
    pub(super) fn policy(&self) -> u64 {
        self.policy
    }

    pub(super) fn made(&self) -> u64 {
        self.made
    }

    /// The calls from number `first` on, as far as they are still remembered.
    pub(super) fn since(&self, first: u64) -> impl Iterator<Item = &Call> {
        let remembered = self.made.saturating_sub(CALLS_MAX as u64);
        (first.max(remembered)..self.made).map(|number| &self.calls[(number % CALLS_MAX as u64) as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_are_remembered_in_order_up_to_a_limit() {
        let mut ring = CallRing::new();
        for number in 0..CALLS_MAX + 10 {
            ring.note(CallKind::Imagine, Some(&[number as f32; 4].into()), CallOutcome::Refused);
        }
        let seen = |first| -> Vec<f32> { ring.since(first).map(|call| call.action.unwrap()[0]).collect() };
        assert_eq!(seen(ring.made() - 2), [40.0, 41.0]);
        assert_eq!((seen(0).len(), seen(0)[0]), (CALLS_MAX, 10.0));
        assert!(seen(ring.made()).is_empty());
    }
}
