//! How a run ends.

use rcwm_models::wire::LinkError;

use super::Cause;
use crate::policy::NoSuchSurprise;

/// Why the loop could not go on.
#[derive(Debug, thiserror::Error)]
pub enum ControllerError {
    /// A limit of a surprise that the policy does not have.
    #[error(transparent)]
    NoSuchSurprise(#[from] NoSuchSurprise),
    /// The link failed.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Nobody published an observation.
    #[error(
        "no observation came on instance {instance:?} in {timeout_s} s; start `rcwm-simulator serve --task TASK --instance {instance}` \
         (same user, same RCWM_PREFIX), or wait longer with --timeout"
    )]
    NoObservation {
        instance: String,
        /// How long was waited, in s.
        timeout_s: f64,
    },
    /// The loop panicked: a fault of the program. The simulator was told that no further action will come.
    #[error(
        "the controller's loop panicked, and the robot was told that it ends: {0}; this is a fault of the program, please \
         report it with the command and, if there is one, the log"
    )]
    Panicked(String),
    /// Zeros are no rest for the policy.
    #[error(
        "--fallback zero would send the robot to the pose of zeros, for the bundle's actions are absolute positions; use \
         --fallback hold or interface, or name a pose as numbers"
    )]
    ZeroIsAPose,
    /// A number to fall back to is one that the robot may not be commanded.
    #[error("--fallback: number {at} is {found}, the bundle's actions go from {low} to {high} there")]
    FallbackLimits {
        /// From 1 on.
        at: usize,
        found: f32,
        low: f32,
        high: f32,
    },
    /// The pose to fall back to has another count of numbers than the policy's actions.
    #[error("--fallback names {found} numbers, the bundle's actions have {expected}")]
    FallbackNumbers { found: usize, expected: usize },
    /// The peer was there and has been silent for too long.
    #[error(
        "the peer on instance {instance:?} has been silent for {silence_s} s; look after it, or wait longer with \
         --silence-max"
    )]
    PeerLost {
        instance: String,
        /// The limit, in s.
        silence_s: f64,
    },
    /// The fallback was sent for as long as allowed.
    #[error(
        "stopped after {ticks} fallback actions in a row: {cause}; look at the counts of the summary, check the bundle with \
         `rcwm-runtime verify`, or allow more with --fallback-ticks-max"
    )]
    Stopped {
        /// Why the policy gave nothing valid.
        cause: Cause,
        /// The limit.
        ticks: u32,
    },
}

/// Why the loop ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Ended {
    /// The simulator said that it closes.
    SimulatorClosed,
    /// The number of episodes that was asked for is reached.
    Episodes,
    /// The user asked for it.
    Interrupted,
    /// The peer was silent for too long.
    PeerLost,
    /// The policy gave nothing valid for too long.
    Stopped,
    /// Another error ended it.
    Failed,
}

impl From<&ControllerError> for Ended {
    fn from(error: &ControllerError) -> Self {
        match error {
            ControllerError::PeerLost { .. } => Self::PeerLost,
            ControllerError::Stopped { .. } => Self::Stopped,
            ControllerError::Link(_)
            | ControllerError::NoObservation { .. }
            | ControllerError::Panicked(_)
            | ControllerError::FallbackNumbers { .. }
            | ControllerError::FallbackLimits { .. }
            | ControllerError::NoSuchSurprise(_)
            | ControllerError::ZeroIsAPose => Self::Failed,
        }
    }
}
