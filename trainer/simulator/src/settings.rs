//! How episodes are served.

use std::path::PathBuf;
use std::time::Duration;

use crate::policy::Policy;

/// How time passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// Each observation waits for its answer.
    LockStep,
    /// As lock-step with a scripted policy, but nobody is waited for.
    Free,
    /// A fixed clock.
    RealTime {
        /// Time between two observations.
        period_ns: u64,
    },
}

/// How to serve.
#[derive(Debug, Clone)]
pub struct ServeSettings {
    /// The link's name, for messages.
    pub instance: String,
    /// The first episode's number.
    pub first_episode: u64,
    /// How many episodes; `None` until stopped.
    pub episodes: Option<u64>,
    /// Decisions in an episode, 1 to [`STEPS_MAX`].
    pub steps_max: u32,
    /// How time passes.
    pub pace: Pace,
    /// Who decides.
    pub policy: Policy,
    /// The longest silence of the controller that is borne: at any time in lock-step, before the first episode in real
    /// time. `None` for ever.
    pub silence_max: Option<Duration>,
    /// Folder for pictures of the first episode.
    pub snapshots: Option<PathBuf>,
}
