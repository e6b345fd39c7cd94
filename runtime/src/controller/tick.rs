//! What observers are shown of a tick.

use rcwm_models::wire::{Action, Observation};

use super::{Counters, EpisodeResult, Episodes, State};
use crate::policy::{Decision, Policy};
use crate::telemetry::Telemetry;

/// When things happened in one tick, CLOCK_MONOTONIC in ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TickTimes {
    /// When the observation was due; in lock-step when it was published.
    pub scheduled_ns: u64,
    /// When it was published; 0 where none came.
    pub published_ns: u64,
    /// When it was received, or found overdue.
    pub received_ns: u64,
    /// When the answer was published; 0 where it was not, see [`Tick::overtaken`].
    pub sent_ns: u64,
}

/// What happened in one tick; shown to observers after the action was sent.
pub struct Tick<'a> {
    /// The observation, in shared memory; none where it was missing.
    pub observation: Option<&'a Observation<'a>>,
    /// Whether the policy's state started anew.
    pub is_first: bool,
    /// The state went back to before this tick was imagined, because its observation came after all.
    pub rewound: bool,
    /// What the policy decided, on the observation or on an imagined frame; none where it was invalid or not asked.
    pub decision: Option<Decision>,
    /// What was sent.
    pub answer: Action,
    /// Not sent: a newer observation had come before the answer to this one was ready.
    pub overtaken: bool,
    /// What the controller is up to after the tick.
    pub state: State,
    pub times: TickTimes,
    /// The policy after the tick; its state is that of the last good tick where the answer is a fallback.
    pub policy: &'a Policy,
    /// All so far.
    pub telemetry: &'a Telemetry,
    /// All so far.
    pub counters: &'a Counters,
    /// Whole and cut episodes so far.
    pub episodes: &'a Episodes,
    /// The running episode, this observation included.
    pub running: EpisodeResult,
}

/// Looks on: recorders, status lines. Runs in the loop's thread after the action was sent, so it must be quick.
pub trait TickObserver {
    /// After every tick.
    fn ticked(&mut self, tick: &Tick<'_>);
}
