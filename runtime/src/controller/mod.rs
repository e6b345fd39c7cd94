//! The loop over shared memory: every observation is answered once, and nothing unfit reaches the wire.
//!
//! **What is answered how.** A new observation gets the policy's action. A repeated one (a simulator asks again) gets the same
//! answer without a second tick. A stale one is dropped. One that holds numbers that are not finite, and one on which the
//! policy fails or gives such numbers, gets the fallback action, marked as such. Everything that is sent passes
//! one gate that refuses what is not finite and enforces the bundle's action limits. All of it is counted.
//!
//! **What the policy's state follows.** The state starts anew at the first observation of an episode, and where the controller
//! joins in the middle of one. Observations that were lost in between (real time) are counted; the state goes on.

mod report;
mod sequence;

pub use report::{Counters, EpisodeResult, Pace, RunReport};
pub use sequence::{Arrival, SequenceTracker};

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rcwm_models::ACTION_LEN;
use rcwm_models::wire::{
    Action, ActionSource, ControllerLink, LinkError, LinkSettings, Observation, ObservationFlags,
    ObservationSample, Wait, clock::monotonic_ns,
};

use crate::policy::{Decision, Policy, PolicyError};
use crate::swap::{Moment, Swapper};
use crate::telemetry::{Stage, Telemetry};

/// Longest wait before signals are looked at.
const WAIT_SLICE: Duration = Duration::from_millis(100);
/// Silence after which dead peers are cleaned up and the simulator is asked for its observation.
const QUIET: Duration = Duration::from_secs(1);

/// What is sent when the policy has nothing fit to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Fallback {
    /// The last action that was sent in this episode; zeros before the first.
    Hold,
    /// Zeros: no motion, the gripper half closed.
    Zero,
}

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
    /// What is sent when the policy has nothing fit to send.
    pub fallback: Fallback,
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
    /// An error ended it.
    Failed,
}

/// What happened in one tick; shown to observers after the action was sent.
pub struct Tick<'a> {
    /// The observation, in shared memory.
    pub observation: &'a Observation,
    /// Whether the policy's state started anew.
    pub is_first: bool,
    /// What was sent.
    pub answer: Action,
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
    tracker: SequenceTracker,
    telemetry: Telemetry,
    counters: Counters,
    episodes: Vec<EpisodeResult>,
    running: Option<EpisodeResult>,
    whole_episodes: u64,
    pace: Option<Pace>,
    answer: Option<Action>,
    swapper: Option<Swapper>,
    /// The policy was exchanged: the next observation is the first of an episode to it.
    fresh_policy: bool,
}

impl Controller {
    /// Connects.
    ///
    /// # Errors
    /// [`ControllerError::Link`].
    pub fn open(policy: Policy, settings: ControllerSettings) -> Result<Self, ControllerError> {
        let link = ControllerLink::open(settings.link.clone())?;
        Ok(Self {
            policy,
            link,
            settings,
            tracker: SequenceTracker::default(),
            telemetry: Telemetry::new(),
            counters: Counters::default(),
            episodes: Vec::new(),
            running: None,
            whole_episodes: 0,
            pace: None,
            answer: None,
            swapper: None,
            fresh_policy: false,
        })
    }

    /// Takes over policies that are ready at a swap desk.
    pub fn take_swaps(&mut self, swapper: Swapper) {
        self.swapper = Some(swapper);
    }

    fn swap(&mut self, moment: Moment) {
        if let Some(swapper) = &self.swapper
            && swapper.poll(moment, &mut self.policy)
        {
            self.fresh_policy = true;
            self.counters.swaps += 1;
        }
    }

    /// Answers observations until the simulator closes, enough episodes are done, or `stop` is set.
    ///
    /// # Errors
    /// See [`ControllerError`]. Faults of policy, peer or order are no errors: they are counted.
    pub fn run(
        &mut self,
        stop: &AtomicBool,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<Ended, ControllerError> {
        let start = Instant::now();
        let mut quiet_since = start;
        loop {
            if stop.load(Ordering::Relaxed) {
                return Ok(Ended::Interrupted);
            }
            match self.link.wait_observation(WAIT_SLICE) {
                Ok(Wait::Message(sample)) => {
                    self.take(&sample, observers)?;
                    quiet_since = Instant::now();
                }
                Ok(Wait::TimedOut) => quiet_since = self.idle(start, quiet_since)?,
                Ok(Wait::Closed) if !self.settings.stay => return Ok(Ended::SimulatorClosed),
                Ok(Wait::Closed) => self.cut_episode(),
                // A signal interrupts waiting; it has set `stop`.
                Err(_) if stop.load(Ordering::Relaxed) => return Ok(Ended::Interrupted),
                Err(error) => return Err(error.into()),
            }
            if self.settings.episodes_max.is_some_and(|max| self.whole_episodes >= max) {
                return Ok(Ended::Episodes);
            }
        }
    }

    /// Nothing came for a while. Gives the time from which on the next silence counts.
    fn idle(&mut self, start: Instant, quiet_since: Instant) -> Result<Instant, ControllerError> {
        self.swap(if self.running.is_some() { Moment::InEpisode } else { Moment::BetweenEpisodes });
        if self.counters.observations == 0
            && let Some(timeout) = self.settings.first_timeout
            && start.elapsed() >= timeout
        {
            return Err(ControllerError::NoObservation {
                instance: self.settings.link.instance.clone(),
                timeout_s: timeout.as_secs_f64(),
            });
        }
        if quiet_since.elapsed() < QUIET {
            return Ok(quiet_since);
        }
        self.link.clean_up_dead_peers();
        self.link.hello()?;
        Ok(Instant::now())
    }

    fn take(
        &mut self,
        sample: &ObservationSample,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<(), ControllerError> {
        let received_ns = monotonic_ns();
        let observation: &Observation = sample.payload();
        let arrival = self.tracker.place(sample.origin().value(), observation.sequence, observation.episode);
        self.counters.note(arrival);
        match arrival {
            Arrival::Stale => Ok(()),
            Arrival::Repeated => self.answer_again(),
            Arrival::Joined { .. } => self.answer_new(observation, true, received_ns, observers),
            Arrival::Next { new_episode, .. } => {
                let is_first = new_episode || observation.is(ObservationFlags::FIRST);
                self.answer_new(observation, is_first, received_ns, observers)
            }
        }
    }

    fn answer_again(&mut self) -> Result<(), ControllerError> {
        if let Some(answer) = self.answer {
            self.link.send(answer)?;
            self.counters.answers += 1;
        }
        Ok(())
    }

    fn answer_new(
        &mut self,
        observation: &Observation,
        is_first: bool,
        received_ns: u64,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<(), ControllerError> {
        if is_first {
            self.answer = None;
            // Here only where the last episode was cut: else it happened in the idle time after its end.
            self.swap(Moment::BetweenEpisodes);
        }
        let (source, action) = match self.decide(observation, is_first) {
            Some(decision) => (ActionSource::Policy, decision.action),
            None => (ActionSource::Fallback, self.fallback()),
        };
        let answer = self.send(observation, source, action, received_ns)?;
        self.count_episode(observation, is_first);
        self.show(observation, is_first, answer, observers);
        self.finish_episode(observation);
        self.swap(match observation.is(ObservationFlags::LAST) {
            true => Moment::BetweenEpisodes,
            false => Moment::InEpisode,
        });
        Ok(())
    }

    /// The policy's decision, unless the observation or the policy is unfit.
    fn decide(&mut self, observation: &Observation, is_first: bool) -> Option<Decision> {
        if !observation.is_finite() {
            self.counters.refused_observations += 1;
            return None;
        }
        let fresh_policy = std::mem::take(&mut self.fresh_policy);
        let is_first = is_first || fresh_policy;
        match self.policy.observe(&observation.image, (!is_first).then_some(&observation.executed_action)) {
            Ok(decision) => {
                for (stage, time_ns) in Stage::POLICY.into_iter().zip(decision.stage_ns) {
                    self.telemetry.record(stage, time_ns);
                }
                Some(decision)
            }
            Err(PolicyError::NotFinite { .. }) => {
                self.counters.non_finite_outputs += 1;
                None
            }
            Err(_) => {
                self.counters.engine_errors += 1;
                None
            }
        }
    }

    fn fallback(&self) -> [f32; ACTION_LEN] {
        match (self.settings.fallback, self.answer) {
            (Fallback::Hold, Some(answer)) => answer.action,
            (Fallback::Hold, None) | (Fallback::Zero, _) => [0.0; ACTION_LEN],
        }
    }

    /// The gate: the only way onto the wire.
    fn send(
        &mut self,
        observation: &Observation,
        mut source: ActionSource,
        mut action: [f32; ACTION_LEN],
        received_ns: u64,
    ) -> Result<Action, ControllerError> {
        if action.iter().any(|x| !x.is_finite()) {
            self.counters.non_finite_outputs += 1;
            (source, action) = (ActionSource::Fallback, [0.0; ACTION_LEN]);
        }
        let action = self.policy.limits().clamp(action);
        let mut answer = Action {
            answers: observation.sequence,
            published_ns: 0,
            source: source as u32,
            reserved: 0,
            action,
        };
        answer.published_ns = self.link.send(answer)?;
        self.answer = Some(answer);
        self.counters.answers += 1;
        self.counters.fallback_answers += u64::from(source == ActionSource::Fallback);
        self.record_times(observation, received_ns, answer.published_ns);
        Ok(answer)
    }

    fn record_times(&mut self, observation: &Observation, received_ns: u64, sent_ns: u64) {
        let telemetry = &mut self.telemetry;
        telemetry.record(Stage::Receive, received_ns.saturating_sub(observation.published_ns));
        telemetry.record(Stage::Tick, sent_ns.saturating_sub(received_ns));
        telemetry.record(Stage::EndToEnd, sent_ns.saturating_sub(observation.published_ns));
        let period_ns = observation.period_ns;
        self.pace = Some(Pace::of(period_ns));
        // One that was sent again for us is older than we are.
        let ours = period_ns > 0 && !observation.is(ObservationFlags::REPEATED);
        let missed = ours && sent_ns > observation.scheduled_ns.saturating_add(period_ns);
        self.counters.missed_deadlines += u64::from(missed);
        let in_time = sent_ns.saturating_sub(observation.published_ns) <= period_ns;
        self.counters.missed_deadlines_published_late += u64::from(missed && in_time);
    }

    fn count_episode(&mut self, observation: &Observation, is_first: bool) {
        if is_first {
            self.cut_episode();
        }
        self.running.get_or_insert_with(|| EpisodeResult::start(observation)).add(observation);
    }

    fn show(
        &self,
        observation: &Observation,
        is_first: bool,
        answer: Action,
        observers: &mut [&mut dyn TickObserver],
    ) {
        let Some(running) = self.running else { return };
        let Self { policy, telemetry, counters, episodes, .. } = self;
        let tick = Tick { observation, is_first, answer, policy, telemetry, counters, episodes, running };
        for observer in observers {
            observer.ticked(&tick);
        }
    }

    fn finish_episode(&mut self, observation: &Observation) {
        if observation.is(ObservationFlags::LAST)
            && let Some(mut episode) = self.running.take()
        {
            episode.whole = episode.from_first;
            self.whole_episodes += u64::from(episode.whole);
            self.episodes.push(episode);
        }
    }

    /// Puts aside an episode whose last observation will not come.
    fn cut_episode(&mut self) {
        self.episodes.extend(self.running.take());
    }

    /// What happened so far.
    #[must_use]
    pub fn report(&self, engine: crate::EngineKind, ended: Ended) -> RunReport {
        let mut episodes = self.episodes.clone();
        episodes.extend(self.running);
        let instance = self.settings.link.instance.clone();
        RunReport::new(self.policy.manifest(), engine, instance, self.pace, ended, &self.counters, episodes)
            .with_latencies(self.telemetry.latencies())
    }

    /// Tells the simulator that no further action will come.
    ///
    /// # Errors
    /// [`ControllerError::Link`].
    pub fn close(self) -> Result<(), ControllerError> {
        Ok(self.link.close()?)
    }
}
