//! The loop over shared memory: every observation is answered once, and nothing invalid reaches the wire.
//!
//! **What is answered how.** A new observation gets the policy's action. A repeated one (a simulator asks again) gets the same
//! answer without a second tick. A stale one is dropped. In real time one that is missing is answered by what the world model
//! imagines, and after some of those by the fallback action. One that holds numbers that are not finite, and one on which the
//! policy fails, gives such numbers, or is more surprised than allowed, gets the fallback action. [`step`] is all of that as one
//! pure function; `docs/controller.md` draws it. Everything that is sent passes one safety filter that refuses what is not
//! finite and enforces the limits. All of it is counted.
//!
//! **What the policy's state follows.** The state starts anew at the first observation of an episode, and where the controller
//! joins in the middle of one. An imagined frame moves it on; when the observation comes after all and is fresh, the state goes
//! back to before it was imagined. Observations that were lost while nobody looked are counted; the state goes on, and the next
//! image corrects it.

mod ended;
mod episode_result;
mod episodes;
mod guard;
mod imagined;
mod machine;
mod report;
mod safety_filter;
mod sending;
mod sequence;
mod settings;
mod surprise;
mod tick;
mod tick_handler;
mod times;
mod transport;

pub use ended::{ControllerError, Ended};
pub use episode_result::EpisodeResult;
pub use episodes::{EPISODES_KEPT, Episodes};
pub use machine::{Cause, Event, Response, State, TickLimits, step};
pub use report::{Counters, Pace, RunReport};
pub use safety_filter::{Fallback, Passed, SafetyFilter};
pub use sequence::{Arrival, SequenceTracker};
pub use settings::ControllerSettings;
pub use surprise::{BranchSurprise, SurpriseReport};

pub use crate::policy::SurpriseLimits;
pub use tick::{Tick, TickObserver, TickTimes};
pub use transport::Transport;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rcwm_models::wire::{Action, ControllerLink, LinkError, ObservationSample, Wait};

use crate::pacing::{Pacing, Plan};
use crate::policy::{InputReader, Policy};
use crate::swap::{Moment, Swapper};
use crate::telemetry::{Stage, Telemetry};
use imagined::Imagined;
use surprise::SurpriseTelemetry;

/// Longest wait before signals are looked at.
const WAIT_SLICE: Duration = Duration::from_millis(100);
/// Silence after which dead peers are cleaned up and the simulator is asked for its observation.
const QUIET: Duration = Duration::from_millis(500);

/// A policy on a link.
pub struct Controller {
    policy: Policy,
    link: Box<dyn Transport>,
    settings: ControllerSettings,
    state: State,
    tracker: SequenceTracker,
    pacing: Pacing,
    filter: SafetyFilter,
    /// What of an observation the policy reads.
    inputs: InputReader,
    telemetry: Telemetry,
    surprise: SurpriseTelemetry,
    counters: Counters,
    episodes: Episodes,
    running: Option<EpisodeResult>,
    whole_episodes: u64,
    pace: Option<Pace>,
    /// The last answer, in this episode.
    answer: Option<Action>,
    /// The answer to the last observation.
    own_answer: Option<Action>,
    imagined: Imagined,
    /// A newer observation that was found while the last was worked on.
    newer: Option<ObservationSample>,
    /// An overdue tick was given its last chance.
    looked: bool,
    swapper: Option<Swapper>,
    /// The policy was exchanged: the next observation is the first of an episode to it.
    fresh_policy: bool,
}

/// What the link has brought.
enum Brought {
    Observation(ObservationSample),
    Nothing,
    Overdue,
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
    /// [`ControllerError::Link`], or what is wrong with the fallback.
    pub fn open(policy: Policy, settings: ControllerSettings) -> Result<Self, ControllerError> {
        // What is wrong with the settings is said before anybody is connected to.
        let filter = settings.safety_filter(&policy)?;
        let manifest = policy.manifest().clone();
        let link = ControllerLink::open(settings.link.clone(), move |robot| manifest.mismatches(robot))?;
        Ok(Self::with(Box::new(link), filter, policy, settings))
    }

    /// A controller on a transport that is open.
    ///
    /// # Errors
    /// What is wrong with the fallback.
    pub fn on(
        link: Box<dyn Transport>,
        policy: Policy,
        settings: ControllerSettings,
    ) -> Result<Self, ControllerError> {
        let filter = settings.safety_filter(&policy)?;
        Ok(Self::with(link, filter, policy, settings))
    }

    fn with(
        link: Box<dyn Transport>,
        filter: SafetyFilter,
        policy: Policy,
        settings: ControllerSettings,
    ) -> Self {
        Self {
            link,
            state: State::default(),
            tracker: SequenceTracker::default(),
            pacing: Pacing::new(settings.pacing),
            filter,
            inputs: InputReader::of(policy.manifest()),
            telemetry: Telemetry::new(),
            surprise: SurpriseTelemetry::new(),
            counters: Counters::default(),
            episodes: Episodes::default(),
            running: None,
            whole_episodes: 0,
            pace: None,
            answer: None,
            own_answer: None,
            imagined: Imagined::new(settings.ticks.imagined_ticks_max, policy.state()),
            newer: None,
            looked: false,
            policy,
            settings,
            swapper: None,
            fresh_policy: false,
        }
    }

    /// Takes over policies that are ready at a swap server.
    pub fn take_swaps(&mut self, swapper: Swapper) {
        self.swapper = Some(swapper);
    }

    /// Takes over a policy that is ready. What was imagined was the old one's.
    fn swap(&mut self, moment: Moment) {
        if let Some(swapper) = &self.swapper
            && swapper.poll(moment, &mut self.policy)
        {
            self.filter.take_limits(self.policy.limits());
            self.inputs = InputReader::of(self.policy.manifest());
            self.imagined.clear();
            self.fresh_policy = true;
            self.counters.swaps += 1;
        }
    }

    /// Nothing came: time for what need not be done in a tick.
    fn idle(&mut self, heard_ns: u64, asked_ns: &mut u64) -> Result<(), ControllerError> {
        self.swap(if self.running.is_some() { Moment::InEpisode } else { Moment::BetweenEpisodes });
        self.check_timeout(heard_ns)?;
        self.ask_again(heard_ns, asked_ns)
    }

    /// Answers observations until the simulator closes, enough episodes are done, or `stop` is set. However that ends, the simulator
    /// has been told when this returns.
    ///
    /// # Errors
    /// See [`ControllerError`]. Faults of policy, peer or order are no errors as long as they pass: they are counted.
    pub fn run(
        &mut self,
        stop: &AtomicBool,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<Ended, ControllerError> {
        let result = guard::guarded(|| self.answer_all(stop, observers));
        // First the robot, then everything else. Where it cannot be told, `close` tries again and tells.
        let _ = self.link.say_closed();
        result.unwrap_or_else(|said| Err(ControllerError::Panicked(said)))
    }

    fn answer_all(
        &mut self,
        stop: &AtomicBool,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<Ended, ControllerError> {
        let start_ns = self.link.now_ns();
        let (mut heard_ns, mut asked_ns) = (start_ns, start_ns);
        loop {
            if stop.load(Ordering::Relaxed) {
                return Ok(Ended::Interrupted);
            }
            let taken = match self.bring(stop)? {
                Brought::Observation(sample) => self.take(&sample, observers)?,
                Brought::Nothing => Taken::Nothing,
                Brought::Overdue => {
                    self.looked = false;
                    self.handle_missing(observers)?;
                    Taken::Nothing
                }
                Brought::Closed if !self.settings.stay => return Ok(Ended::SimulatorClosed),
                Brought::Closed => {
                    self.leave();
                    Taken::Nothing
                }
            };
            if taken == Taken::Nothing {
                self.idle(heard_ns, &mut asked_ns)?;
            } else {
                heard_ns = self.link.now_ns();
            }
            self.looked &= taken != Taken::New;
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
        let mut plan = self.pacing.plan(self.link.now_ns());
        if plan == Plan::GetReady {
            self.get_ready();
            plan = self.pacing.plan(self.link.now_ns());
        }
        let wait = match plan {
            // What has come while the time ran out wins, but is looked at once: observations of no use, however many, do not keep
            // an overdue tick from its turn.
            Plan::Overdue if self.looked => Ok(Wait::TimedOut),
            // Not twice in a row; who comes back with nothing asks again.
            Plan::GetReady => Ok(Wait::TimedOut),
            Plan::Overdue => {
                self.looked = true;
                self.link.poll().map(|sample| sample.map_or(Wait::TimedOut, Wait::Message))
            }
            Plan::Wait { spin, timeout } => {
                self.looked = false;
                if spin > Duration::ZERO {
                    self.policy.wake();
                }
                self.link.wait(spin, timeout.min(WAIT_SLICE))
            }
        };
        match wait {
            Ok(Wait::Message(sample)) => Ok(Brought::Observation(sample)),
            Ok(Wait::TimedOut) if self.looked => Ok(Brought::Overdue),
            Ok(Wait::TimedOut) => Ok(Brought::Nothing),
            Ok(Wait::Closed) => Ok(Brought::Closed),
            // No observation of this robot's, whatever it is: nothing is known but that it came.
            Err(LinkError::MessageLength { .. }) => {
                self.counters.refused_observations += 1;
                Ok(Brought::Nothing)
            }
            // A signal interrupts waiting; it has set `stop`.
            Err(_) if stop.load(Ordering::Relaxed) => Ok(Brought::Nothing),
            Err(error) => Err(error.into()),
        }
    }

    /// Looks whether a newer observation has come.
    fn take_newer(&mut self) -> Result<(), ControllerError> {
        self.newer = match self.link.poll() {
            Err(LinkError::MessageLength { .. }) => {
                self.counters.refused_observations += 1;
                None
            }
            polled => polled?,
        };
        Ok(())
    }

    /// Prepares the policy for an observation that will come soon.
    fn get_ready(&mut self) {
        let start_ns = self.link.now_ns();
        self.policy.warm_caches();
        let took = self.since(start_ns);
        self.pacing.got_ready(took);
        self.telemetry.record(Stage::Ready, took.as_nanos() as u64);
    }

    /// The peer has said that it leaves.
    fn leave(&mut self) {
        self.state = step(self.state, Event::Left, self.settings.ticks).0;
        self.pacing.rest();
        self.cut_episode();
        // The next one may offer something else; it is looked at anew.
        self.link.forget_robot();
    }

    /// Ends the run when nobody has been there for too long.
    fn check_timeout(&self, heard_ns: u64) -> Result<(), ControllerError> {
        let instance = || self.settings.link.instance.clone();
        let over = |max: Option<Duration>| max.filter(|max| self.since(heard_ns) >= *max);
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
    fn ask_again(&self, heard_ns: u64, asked_ns: &mut u64) -> Result<(), ControllerError> {
        if self.since(heard_ns) >= QUIET && self.since(*asked_ns) >= QUIET {
            self.link.clean_up_dead_peers();
            self.link.hello()?;
            *asked_ns = self.link.now_ns();
        }
        Ok(())
    }

    fn since(&self, start_ns: u64) -> Duration {
        Duration::from_nanos(self.link.now_ns().saturating_sub(start_ns))
    }

    /// What happened so far.
    #[must_use]
    pub fn report(&self, engine: crate::EngineKind, ended: Ended) -> RunReport {
        let mut episodes = self.episodes.clone();
        self.running.into_iter().for_each(|running| episodes.push(running));
        let instance = self.settings.link.instance.clone();
        let report = RunReport::new(
            self.policy.manifest(),
            engine,
            instance,
            self.pace,
            ended,
            &self.counters,
            &episodes,
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

    /// Tells the simulator that no further action will come, unless [`Self::run`] has.
    ///
    /// # Errors
    /// [`ControllerError::Link`].
    pub fn close(&self) -> Result<(), ControllerError> {
        Ok(self.link.say_closed()?)
    }
}
