//! What a log holds after its header.

use std::sync::Arc;

use rcwm_models::wire::{
    Action, ActionValues, CAMERAS_MAX, Format, Observation, ObservationHeader, OwnedObservation,
};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::header::{BundleIdentity, check_count};
use super::pack::{PackedImage, PackedMask};
use crate::policy::{BranchState, CallKind, State, Surprise};

/// Version of the file.
pub const VERSION: u32 = 2;
/// One record of so many holds the whole state and a whole picture.
pub const KEYFRAME_TICKS: u64 = 256;
/// Bytes of a state's digest.
pub const DIGEST_BYTES: usize = 16;

/// One entry after the header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Record {
    Tick(Box<TickRecord>),
    /// The canonical text of the interface by which what follows was observed.
    Interface(String),
    /// From here on another policy ran, from its initial state.
    Policy(BundleIdentity),
    /// The log was finished properly.
    End {
        ticks: u64,
        /// Ticks that were dropped.
        dropped: u64,
    },
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TickRecord {
    /// Ticks before it that were dropped because the writer could not keep up.
    pub dropped_before: u64,
    /// Calls before it are not in the log (dropped with their ticks): a replay takes `state` over and goes on from here.
    pub resumes: bool,
    /// The policy's state started anew.
    pub is_first: bool,
    /// What was observed; none where nothing came.
    pub observed: Option<Observed>,
    /// When the observation was due, in ns of the monotonic clock.
    pub scheduled_ns: u64,
    /// When it was received, or found overdue.
    pub received_ns: u64,
    /// The answer was not sent: a newer observation had come before it was ready.
    pub overtaken: bool,
    /// What the policy was asked since the last tick, and how it went.
    pub calls: Vec<LoggedCall>,
    /// What was sent.
    pub answer: Answer,
    /// Digest of the state after the calls.
    pub digest: [u8; DIGEST_BYTES],
    /// The whole state after them, in keyframes.
    pub state: Option<WholeState>,
}

impl TickRecord {
    /// Whether its actions are of so many numbers; if not, which is not.
    pub(super) fn check_counts(&self, numbers: usize) -> Result<(), String> {
        for call in &self.calls {
            if let Some(action) = &call.action {
                check_count("a call's action", action.len(), numbers)?;
            }
            if let LoggedOutcome::Decided { action, .. } = &call.outcome {
                check_count("a decision", action.len(), numbers)?;
            }
        }
        match self.answer.action.len() {
            // What was not sent may be nothing.
            0 if self.overtaken => Ok(()),
            found => check_count("an answer", found, numbers),
        }
    }
}

/// An observation, its pictures packed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Observed {
    /// See [`ObservationHeader::sequence`].
    pub sequence: u64,
    /// See [`ObservationHeader::episode`].
    pub episode: u64,
    /// See [`ObservationHeader::scheduled_ns`].
    pub scheduled_ns: u64,
    /// See [`ObservationHeader::published_ns`].
    pub published_ns: u64,
    /// See [`ObservationHeader::period_ns`].
    pub period_ns: u64,
    /// See [`ObservationHeader::captured_ns`].
    pub captured_ns: [u64; CAMERAS_MAX],
    /// See [`ObservationHeader::step`].
    pub step: u32,
    /// See [`ObservationHeader::flags`].
    pub flags: u32,
    /// See [`ObservationHeader::task`].
    pub task: u32,
    /// See [`ObservationHeader::reward`].
    pub reward: f32,
    /// See [`Observation::executed`].
    pub executed: ActionValues,
    /// See [`Observation::state`].
    pub state: Vec<f32>,
    /// See [`Observation::image`], one a camera.
    pub images: Vec<PackedImage>,
    /// See [`Observation::mask`]; one bit a pixel, where there is one.
    pub masks: Vec<Option<PackedMask>>,
}

impl Observed {
    /// Of an observation with its packed pictures and masks, one a camera.
    #[must_use]
    pub fn of(
        observation: &Observation<'_>,
        images: Vec<PackedImage>,
        masks: Vec<Option<PackedMask>>,
    ) -> Self {
        let o = observation;
        Self {
            sequence: o.sequence,
            episode: o.episode,
            scheduled_ns: o.scheduled_ns,
            published_ns: o.published_ns,
            period_ns: o.period_ns,
            captured_ns: o.captured_ns,
            step: o.step,
            flags: o.flags,
            task: o.task,
            reward: o.reward,
            executed: o.executed_action(),
            state: o.state().to_vec(),
            images,
            masks,
        }
    }

    /// The observation but for pictures and masks, which are zeros.
    ///
    /// # Errors
    /// What in it is not of the format.
    pub fn without_pictures(&self, format: &Arc<Format>) -> Result<OwnedObservation, String> {
        let mut observation = OwnedObservation::zeroed(format);
        *observation = ObservationHeader {
            sequence: self.sequence,
            episode: self.episode,
            scheduled_ns: self.scheduled_ns,
            published_ns: self.published_ns,
            period_ns: self.period_ns,
            captured_ns: self.captured_ns,
            step: self.step,
            flags: self.flags,
            task: self.task,
            reward: self.reward,
        };
        let mut edited = observation.edit();
        for (what, to, from) in [
            ("state", edited.state().len(), self.state.len()),
            ("executed action", edited.executed().len(), self.executed.len()),
        ] {
            if to != from {
                return Err(format!("{what} of {from} numbers, the interface has {to}"));
            }
        }
        edited.state().copy_from_slice(&self.state);
        edited.executed().copy_from_slice(&self.executed);
        Ok(observation)
    }
}

/// What was sent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// See [`Action::answers`].
    pub answers: u64,
    /// See [`Action::published_ns`].
    pub published_ns: u64,
    /// See [`Action::source`].
    pub source: u32,
    /// See [`Action::action`].
    pub action: ActionValues,
}

impl From<Action> for Answer {
    fn from(action: Action) -> Self {
        let Action { answers, published_ns, source, action, .. } = action;
        Self { answers, published_ns, source, action }
    }
}

/// A call of the policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LoggedCall {
    /// What was asked.
    pub kind: CallKind,
    /// The action it was about; none at an episode's start.
    pub action: Option<ActionValues>,
    /// What the policy decided, or how it failed.
    pub outcome: LoggedOutcome,
}

/// How a call ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "read and written one by one")]
pub enum LoggedOutcome {
    /// Work ahead was done, in so many ns.
    Done(u64),
    /// The policy went back to an earlier state, the one with this checksum.
    StateSet(u32),
    /// A decision was made.
    Decided {
        action: ActionValues,
        /// Work ahead was done again.
        recomputed: bool,
        /// How unexpected the picture was.
        surprise: Option<Surprise>,
        /// Time in each of [`Header::stages`], in ns.
        stage_ns: Vec<u64>,
    },
    /// It failed, in these words.
    Failed(String),
}

/// z and h of every branch, and where the random generator stands. A policy of one branch has the first only.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WholeState {
    robot_z: Vec<i64>,
    robot_h: Vec<f32>,
    environment_z: Vec<i64>,
    environment_h: Vec<f32>,
    noise_position: u128,
}

impl WholeState {
    /// Of the policy's state, and where its random generator stands.
    #[must_use]
    pub fn of(state: &State, noise_position: u128) -> Self {
        let mut branches = state.branches.iter().map(|branch| (branch.z.clone(), branch.h.clone()));
        let mut next = || branches.next().unwrap_or_default();
        let ((robot_z, robot_h), (environment_z, environment_h)) = (next(), next());
        Self { robot_z, robot_h, environment_z, environment_h, noise_position }
    }

    /// The policy's state, and where its random generator stands.
    #[must_use]
    pub fn restore(&self) -> (State, u128) {
        let branch = |z: &[i64], h: &[f32]| BranchState { z: z.to_vec(), h: h.to_vec() };
        let mut branches = vec![branch(&self.robot_z, &self.robot_h)];
        if !self.environment_h.is_empty() {
            branches.push(branch(&self.environment_z, &self.environment_h));
        }
        (State { branches }, self.noise_position)
    }
}

/// The first half of the sha256 over the bits of z and h of every branch.
pub fn digest(state: &State) -> [u8; DIGEST_BYTES] {
    let mut hash = Sha256::new();
    for branch in &state.branches {
        branch.z.iter().for_each(|class| hash.update(class.to_le_bytes()));
        branch.h.iter().for_each(|value| hash.update(value.to_le_bytes()));
    }
    let whole = hash.finalize();
    std::array::from_fn(|index| whole[index])
}
