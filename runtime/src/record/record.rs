//! What the loop hands over of a tick.

use std::path::PathBuf;
use std::sync::Arc;

use rcwm_models::bundle::Manifest;
use rcwm_models::wire::{Action, ActionValues, Format, OwnedObservation};

use crate::controller::{Counters, EpisodeResult, Tick, TickTimes};
use crate::policy::{CALLS_MAX, Call, Policy, State};
use crate::telemetry::{RECENT_MAX, Stage};

/// Most recordings, and most ended episodes, in one record: more, as after dropped ticks, go into the next ones.
const RECORDINGS_MAX: usize = 64;
const ENDED_MAX: usize = 4;

/// A tick on its way to the writer. Its buffers are used again and again.
pub struct Record {
    /// Whether something was observed.
    pub observed: bool,
    /// The observation; its picture and mask only where a sink wants them.
    pub observation: OwnedObservation,
    /// The policy's state started anew.
    pub is_first: bool,
    /// The answer was not sent.
    pub overtaken: bool,
    pub times: TickTimes,
    /// What was sent.
    pub answer: Action,
    /// What the policy was asked since the last record.
    pub calls: Vec<Call>,
    /// Calls before these are missing.
    pub resumes: bool,
    /// Ticks without a record since the last one.
    pub dropped_before: u64,
    /// The policy's state afterwards.
    pub state: State,
    /// Where the policy's random generator stands.
    pub noise_position: u128,
    /// Another policy than in the last record.
    pub exchanged: Option<Box<RunningPolicy>>,
    /// Times measured since the last record.
    pub recordings: Vec<(Stage, u64)>,
    /// All so far.
    pub counters: Counters,
    /// Episodes that have ended since the last record.
    pub ended: Vec<EpisodeResult>,
    /// Whole episodes so far, and the successful ones of them.
    pub whole: [u64; 2],
    pub running: EpisodeResult,
}

/// Which policy runs.
#[derive(Debug, Clone, PartialEq)]
pub struct RunningPolicy {
    /// The bundle's manifest.
    pub manifest: Manifest,
    /// The bundle's folder.
    pub folder: PathBuf,
}

impl RunningPolicy {
    /// What is told of a policy.
    #[must_use]
    pub fn of(policy: &Policy) -> Self {
        Self { manifest: policy.manifest().clone(), folder: policy.folder().to_path_buf() }
    }
}

/// How far the records have come.
pub(super) struct Progress {
    policy: u64,
    calls: u64,
    recordings: u64,
    episodes: u64,
    pub(super) dropped: u64,
}

impl Progress {
    pub(super) fn of(policy: &Policy) -> Self {
        Self { policy: policy.number(), calls: 0, recordings: 0, episodes: 0, dropped: 0 }
    }
}

impl Record {
    pub(super) fn new(policy: &Policy, format: &Arc<Format>) -> Self {
        let observation = OwnedObservation::zeroed(format);
        Self {
            observed: false,
            running: EpisodeResult::start(&observation),
            observation,
            is_first: false,
            overtaken: false,
            times: TickTimes { scheduled_ns: 0, published_ns: 0, received_ns: 0, sent_ns: 0 },
            answer: Action { answers: 0, published_ns: 0, source: 0, action: ActionValues::default() },
            calls: Vec::with_capacity(CALLS_MAX),
            resumes: false,
            dropped_before: 0,
            state: policy.state().clone(),
            noise_position: 0,
            exchanged: None,
            recordings: Vec::with_capacity(RECORDINGS_MAX),
            counters: Counters::default(),
            ended: Vec::with_capacity(ENDED_MAX),
            whole: [0; 2],
        }
    }

    /// Copies the tick; allocates nothing unless the policy was exchanged.
    pub(super) fn fill(&mut self, progress: &mut Progress, tick: &Tick<'_>, pictures: bool) {
        let policy = tick.policy;
        let exchanged = policy.number() != progress.policy;
        if exchanged {
            (progress.policy, progress.calls) = (policy.number(), 0);
        }
        self.exchanged = exchanged.then(|| Box::new(RunningPolicy::of(policy)));
        self.observed = tick.observation.is_some();
        match tick.observation {
            Some(observation) if pictures => self.observation.copy(observation),
            Some(observation) => self.observation.copy_numbers(observation),
            None => {}
        }
        (self.is_first, self.overtaken, self.times) = (tick.is_first, tick.overtaken, tick.times);
        self.answer = tick.answer;
        self.calls.clear();
        self.calls.extend(policy.calls_since(progress.calls).copied());
        let forgotten = policy.calls_made() - progress.calls > self.calls.len() as u64;
        self.resumes = progress.dropped > 0 || forgotten;
        self.dropped_before = progress.dropped;
        self.state.clone_from(policy.state());
        self.noise_position = policy.noise_position();
        self.recordings.clear();
        let recordings = progress.recordings.max(tick.telemetry.recorded().saturating_sub(RECENT_MAX as u64));
        self.recordings.extend(tick.telemetry.recorded_since(recordings).take(RECORDINGS_MAX));
        self.counters = *tick.counters;
        self.ended.clear();
        self.ended.extend(tick.episodes.since(progress.episodes).copied().take(ENDED_MAX));
        self.whole = [tick.episodes.whole(), tick.episodes.successes()];
        self.running = tick.running;
        *progress = Progress {
            policy: progress.policy,
            calls: policy.calls_made(),
            recordings: recordings + self.recordings.len() as u64,
            episodes: progress.episodes + self.ended.len() as u64,
            dropped: 0,
        };
    }
}
