//! The loop over shared memory: every observation is answered once, and nothing unfit reaches the wire.
//!
//! **What is answered how.** A new observation gets the policy's action. A repeated one (a simulator asks again) gets the same
//! answer without a second tick. A stale one is dropped. In real time one that is missing is answered by what the world model
//! imagines, and after some of those by the fallback action. One that holds numbers that are not finite, and one on which the
//! policy fails, gives such numbers, or is more surprised than allowed, gets the fallback action. [`step`] is all of that as one
//! pure function; `docs/controller.md` draws it. Everything that is sent passes one gate that refuses what is not
//! finite and enforces the limits. All of it is counted.
//!
//! **What the policy's state follows.** The state starts anew at the first observation of an episode, and where the controller
//! joins in the middle of one. An imagined frame moves it on; when the observation comes after all and is fresh, the state goes
//! back to before it was imagined. Observations that were lost while nobody looked are counted; the state goes on, and the next
//! image corrects it.

mod answering;
mod gate;
mod machine;
mod report;
mod sequence;
mod surprise;

pub use gate::{Fallback, Gate, Passed};
pub use machine::{Cause, Event, Response, State, TickLimits, step};
pub use report::{Counters, EpisodeResult, Pace, RunReport};
pub use sequence::{Arrival, SequenceTracker};
pub use surprise::{BranchSurprise, SurpriseLimits, SurpriseReport};

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rcwm_models::wire::{
    Action, ControllerLink, LinkError, LinkSettings, Observation, ObservationSample, Wait,
    clock::monotonic_ns,
};

use crate::pacing::{Pacing, PacingSettings, Plan};
use crate::policy::{self, Decision, Policy};
use crate::telemetry::Telemetry;
use surprise::SurpriseTelemetry;

/// Longest wait before signals are looked at.
const WAIT_SLICE: Duration = Duration::from_millis(100);
/// Silence after which dead peers are cleaned up and the simulator is asked for its observation.
const QUIET: Duration = Duration::from_millis(500);

/// How the loop runs.
#[derive(Debug, Clone)]
pub struct ControllerSettings {
    /// The link.
    pub link: LinkSettings,
    /// Ends after this many whole episodes.
    pub episodes_max: Option<u64>,
    /// Waits for another simulator when one has closed.
    pub stay: bool,
    /// Longest wait for the first observation; none waits for ever.
    pub first_timeout: Option<Duration>,
    /// Longest silence of a peer that was there; none waits for ever.
    pub silence_max: Option<Duration>,
    /// How to wait, and what is late.
    pub pacing: PacingSettings,
    /// How long the policy is done without.
    pub ticks: TickLimits,
    /// What is sent when the policy has nothing fit to send.
    pub fallback: Fallback,
    /// How much surprise is borne.
    pub surprise: SurpriseLimits,
    /// Largest change of an action's component from one action to the next; at least 0.
    pub rate_max: Option<f32>,
}

impl ControllerSettings {
    /// Waits for ever, holds the last action as the fallback, and bears any surprise.
    #[must_use]
    pub fn new(link: LinkSettings) -> Self {
        Self {
            link,
            episodes_max: None,
            stay: false,
            first_timeout: None,
            silence_max: None,
            pacing: PacingSettings::default(),
            ticks: TickLimits::default(),
            fallback: Fallback::Hold,
            surprise: SurpriseLimits::default(),
            rate_max: None,
        }
    }
}

/// Why the loop could not go on.
#[derive(Debug, thiserror::Error)]
pub enum ControllerError {
    /// The link failed.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Nobody published an observation.
    #[error(
        "no observation came on instance {instance:?} in {timeout_s} s; start `rcwm-simulator serve --instance {instance}` \
         (same user, same RCWM_PREFIX), or wait longer with --timeout"
    )]
    NoObservation {
        /// The instance.
        instance: String,
        /// How long was waited, in s.
        timeout_s: f64,
    },
    /// The peer was there and has been silent for too long.
    #[error(
        "the peer on instance {instance:?} has been silent for {silence_s} s; look after it, or wait longer with \
         --silence-max"
    )]
    PeerLost {
        /// The instance.
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
        /// Why the policy was unfit.
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
    /// The policy was unfit for too long.
    Stopped,
    /// Another error ended it.
    Failed,
}

impl From<&ControllerError> for Ended {
    fn from(error: &ControllerError) -> Self {
        match error {
            ControllerError::PeerLost { .. } => Self::PeerLost,
            ControllerError::Stopped { .. } => Self::Stopped,
            ControllerError::Link(_) | ControllerError::NoObservation { .. } => Self::Failed,
        }
    }
}

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
    pub observation: Option<&'a Observation>,
    /// Whether the policy's state started anew.
    pub is_first: bool,
    /// The state went back to before this tick was imagined, because its observation came after all.
    pub rewound: bool,
    /// What the policy decided, on the observation or on an imagined frame; none where it was unfit or not asked.
    pub decision: Option<Decision>,
    /// What was sent.
    pub answer: Action,
    /// Not sent: a newer observation had come before the answer to this one was ready.
    pub overtaken: bool,
    /// What the controller is up to after the tick.
    pub state: State,
    /// Times of the tick.
    pub times: TickTimes,
    /// The policy after the tick; its state is that of the last good tick where the answer is a fallback.
    pub policy: &'a Policy,
    /// All so far.
    pub telemetry: &'a Telemetry,
    /// All so far.
    pub counters: &'a Counters,
    /// Whole and cut episodes so far.
    pub episodes: &'a [EpisodeResult],
    /// The running episode, this observation included.
    pub running: EpisodeResult,
}

/// Looks on: recorders, status lines. Runs in the loop's thread after the action was sent, so it must be quick.
pub trait TickObserver {
    /// After every tick.
    fn ticked(&mut self, tick: &Tick<'_>);
}

/// A policy on a link.
pub struct Controller {
    policy: Policy,
    link: ControllerLink,
    settings: ControllerSettings,
    state: State,
    tracker: SequenceTracker,
    pacing: Pacing,
    gate: Gate,
    telemetry: Telemetry,
    surprise: SurpriseTelemetry,
    counters: Counters,
    episodes: Vec<EpisodeResult>,
    running: Option<EpisodeResult>,
    whole_episodes: u64,
    pace: Option<Pace>,
    /// The last answer, in this episode.
    answer: Option<Action>,
    /// The policy's state before each imagined tick since the last observation, with the tick's sequence.
    imagined: Vec<(u64, policy::State)>,
    /// A newer observation that was found while the last was worked on.
    newer: Option<ObservationSample>,
}

/// What the link has brought.
enum Brought {
    Observation(ObservationSample),
    Nothing,
    Closed,
}

/// What an observation was good for.
#[derive(PartialEq, Eq)]
enum Taken {
    /// It was new.
    New,
    /// It had been answered before.
    Again,
    /// There was none, or it was stale.
    Nothing,
}

impl Controller {
    /// Connects.
    ///
    /// # Errors
    /// [`ControllerError::Link`].
    pub fn open(policy: Policy, settings: ControllerSettings) -> Result<Self, ControllerError> {
        let link = ControllerLink::open(settings.link.clone())?;
        Ok(Self {
            link,
            state: State::default(),
            tracker: SequenceTracker::default(),
            pacing: Pacing::new(settings.pacing),
            gate: Gate::new(policy.limits(), settings.rate_max),
            telemetry: Telemetry::new(),
            surprise: SurpriseTelemetry::new(),
            counters: Counters::default(),
            episodes: Vec::new(),
            running: None,
            whole_episodes: 0,
            pace: None,
            answer: None,
            imagined: Vec::with_capacity(settings.ticks.imagined_ticks_max.min(64) as usize),
            newer: None,
            policy,
            settings,
        })
    }

    /// Answers observations until the simulator closes, enough episodes are done, or `stop` is set.
    ///
    /// # Errors
    /// See [`ControllerError`]. Faults of policy, peer or order are no errors as long as they pass: they are counted.
    pub fn run(
        &mut self,
        stop: &AtomicBool,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<Ended, ControllerError> {
        let start = Instant::now();
        let (mut heard, mut asked) = (start, start);
        loop {
            if stop.load(Ordering::Relaxed) {
                return Ok(Ended::Interrupted);
            }
            let taken = match self.bring(stop)? {
                Brought::Observation(sample) => self.take(&sample, observers)?,
                Brought::Nothing => Taken::Nothing,
                Brought::Closed if !self.settings.stay => return Ok(Ended::SimulatorClosed),
                Brought::Closed => {
                    self.leave();
                    Taken::Nothing
                }
            };
            // Observations of no use, however many, do not keep an overdue tick from its turn.
            if taken != Taken::New && self.pacing.plan(monotonic_ns()) == Plan::Overdue {
                self.go_without(observers)?;
            }
            if taken == Taken::Nothing {
                self.bear_silence(heard)?;
                self.ask_again(heard, &mut asked)?;
            } else {
                heard = Instant::now();
            }
            if self.settings.episodes_max.is_some_and(|max| self.whole_episodes >= max) {
                return Ok(Ended::Episodes);
            }
        }
    }

    /// Waits as the schedule has it. An observation that is there wins over one that is overdue.
    fn bring(&mut self, stop: &AtomicBool) -> Result<Brought, ControllerError> {
        if let Some(sample) = self.newer.take() {
            return Ok(Brought::Observation(sample));
        }
        let wait = match self.pacing.plan(monotonic_ns()) {
            Plan::Overdue => match self.link.poll_observation()? {
                Some(sample) => Ok(Wait::Message(sample)),
                None => Ok(Wait::TimedOut),
            },
            Plan::Wait { spin, timeout } => self.link.wait_observation_polling(spin, timeout.min(WAIT_SLICE)),
        };
        match wait {
            Ok(Wait::Message(sample)) => Ok(Brought::Observation(sample)),
            Ok(Wait::TimedOut) => Ok(Brought::Nothing),
            Ok(Wait::Closed) => Ok(Brought::Closed),
            // A signal interrupts waiting; it has set `stop`.
            Err(_) if stop.load(Ordering::Relaxed) => Ok(Brought::Nothing),
            Err(error) => Err(error.into()),
        }
    }

    /// The peer has said that it leaves.
    fn leave(&mut self) {
        self.state = step(self.state, Event::Left, self.settings.ticks).0;
        self.pacing.rest();
        self.cut_episode();
    }

    /// Ends the run when nobody has been there for too long.
    fn bear_silence(&self, heard: Instant) -> Result<(), ControllerError> {
        let instance = || self.settings.link.instance.clone();
        let over = |max: Option<Duration>| max.filter(|max| heard.elapsed() >= *max);
        if self.counters.observations == 0 {
            match over(self.settings.first_timeout) {
                Some(timeout) => Err(ControllerError::NoObservation {
                    instance: instance(),
                    timeout_s: timeout.as_secs_f64(),
                }),
                None => Ok(()),
            }
        } else {
            match over(self.settings.silence_max) {
                Some(max) => {
                    Err(ControllerError::PeerLost { instance: instance(), silence_s: max.as_secs_f64() })
                }
                None => Ok(()),
            }
        }
    }

    /// Cleans up after dead peers and asks for the present observation, once in a while.
    fn ask_again(&self, heard: Instant, asked: &mut Instant) -> Result<(), ControllerError> {
        if heard.elapsed() >= QUIET && asked.elapsed() >= QUIET {
            self.link.clean_up_dead_peers();
            self.link.hello()?;
            *asked = Instant::now();
        }
        Ok(())
    }

    /// What happened so far.
    #[must_use]
    pub fn report(&self, engine: crate::EngineKind, ended: Ended) -> RunReport {
        let mut episodes = self.episodes.clone();
        episodes.extend(self.running);
        let instance = self.settings.link.instance.clone();
        let report = RunReport::new(
            self.policy.manifest(),
            engine,
            instance,
            self.pace,
            ended,
            &self.counters,
            episodes,
        );
        RunReport {
            latency: self.telemetry.latencies(),
            surprise: self.surprise.report(),
            last_state: self.state,
            ..report
        }
    }

    /// Latencies so far.
    #[must_use]
    pub fn telemetry(&self) -> &Telemetry {
        &self.telemetry
    }

    /// Tells the simulator that no further action will come.
    ///
    /// # Errors
    /// [`ControllerError::Link`].
    pub fn close(self) -> Result<(), ControllerError> {
        Ok(self.link.close()?)
    }
}
