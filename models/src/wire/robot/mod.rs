//! A robot of your own on the wire: [`serve`] keeps its time, asks the controller, and looks after what may be executed.
//!
//! In lock-step every observation waits for its answer. In real time an episode begins to run with its first answer: from then on an
//! observation goes out every period of the interface, and a tick without an answer executes the interface's safe action. So does an answer
//! that is not finite, out of limits or of another length; all of it is counted. `rcwm.gym` does the same in Python.

mod guard;
#[cfg(test)]
mod tests;

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

pub use guard::{Guard, Refused};

use super::clock::monotonic_ns;
use super::{Action, ActionValues, LinkError, ObservationFlags, ObservationHeader, ObservationMut};
use super::{OwnedObservation, SimulatorLink, Wait};

/// What a robot says when it fails.
pub type RobotError = Box<dyn std::error::Error + Send + Sync>;

/// A robot, or a simulator of one.
pub trait Robot {
    /// Goes to where an episode starts. What was executed last may still be going on.
    ///
    /// # Errors
    /// The robot's own.
    fn reset(&mut self, episode: u64) -> Result<(), RobotError>;

    /// Fills in pictures, masks, states, capture stamps, and the reward of the last step; of the flags SUCCESS and MASK_VALID, and LAST
    /// and TERMINAL where the episode ends. All else is filled in already.
    ///
    /// # Errors
    /// The robot's own.
    fn observe(&mut self, observation: &mut ObservationMut<'_>) -> Result<(), RobotError>;

    /// Begins to execute an action, in the interface's units and within its limits. Gives what is really executed, which may be another.
    ///
    /// # Errors
    /// The robot's own.
    fn execute(&mut self, action: &ActionValues) -> Result<ActionValues, RobotError>;
}

/// How a robot is served.
#[derive(Debug, Clone, Copy)]
pub struct ServeSettings {
    pub episodes: u64,
    /// Actions an episode, at most.
    pub steps: u32,
    /// At the interface's rate; else every observation waits for its answer, which only a simulator can.
    pub realtime: bool,
    /// Longest wait for an answer where one is waited for.
    pub timeout: Duration,
}

/// What happened.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Served {
    pub episodes: u64,
    /// Episodes with SUCCESS anywhere.
    pub successes: u64,
    pub total_reward: f64,
    pub observations: u64,
    pub answers: u64,
    /// Answers that were executed with changes beyond `rate_max` cut off.
    pub slowed_down: u64,
    /// Answers that were not finite, out of limits or of another length.
    pub refused: u64,
    /// Answers to an earlier observation.
    pub stale_answers: u64,
    /// Safe actions.
    pub rests: u64,
    /// Ticks without an answer in time.
    pub missed_answers: u64,
    pub controllers_left: u64,
    /// Ticks that were left out because the robot was late.
    pub overruns: u64,
}

/// Why a robot is served no longer.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error("the robot failed in episode {episode}: {source}")]
    Robot { episode: u64, source: RobotError },
    #[error("no answer within {timeout_s} s: is a controller running on this instance?")]
    NoAnswer { timeout_s: f64 },
    #[error("the robot measured a number that is not finite at step {step} of episode {episode}")]
    NotFinite { episode: u64, step: u32 },
    #[error(
        "the robot is to hold what is neither commanded nor measured: give the action `measured`, or a safe action"
    )]
    NoRest,
}

/// Longest wait before `stop` is looked at.
const WAIT_SLICE: Duration = Duration::from_millis(100);

/// Serves whole episodes, or until `stop` is set. However that ends, the controller has been told and the robot was given its safe action.
///
/// # Errors
/// See [`ServeError`].
pub fn serve(
    robot: &mut dyn Robot,
    link: SimulatorLink,
    settings: &ServeSettings,
    stop: &AtomicBool,
) -> Result<Served, ServeError> {
    let mut loop_ = Loop {
        robot,
        guard: Guard::new(link.format().interface()),
        observation: OwnedObservation::zeroed(link.format()),
        period_ns: (1e9 / link.format().interface().rate_hz).round() as u64,
        link,
        settings,
        stop,
        served: Served::default(),
        work_ns: 0,
        runs: false,
    };
    // A panic of the robot's program is caught until both are told, and then goes on.
    let goes_on = |_: &u64| !stop.load(Ordering::Relaxed);
    let served_all =
        || (0..settings.episodes).take_while(goes_on).try_for_each(|episode| loop_.episode(episode));
    let result = catch_unwind(AssertUnwindSafe(served_all));
    // The controller first, then the robot: neither is left with the last command.
    let Loop { robot, mut guard, observation, link, served, runs, .. } = loop_;
    let closed = link.close();
    let rest = if runs { guard.rest(observation.view().state()) } else { None };
    let rested = rest.map_or(Ok(()), |rest| robot.execute(&rest).map(drop));
    // What ended the loop comes first.
    result.unwrap_or_else(|panic| resume_unwind(panic))?;
    rested.map_err(|source| ServeError::Robot { episode: served.episodes, source })?;
    closed?;
    Ok(served)
}

struct Loop<'a> {
    robot: &'a mut dyn Robot,
    link: SimulatorLink,
    guard: Guard,
    /// The present one, for a controller that comes now.
    observation: OwnedObservation,
    settings: &'a ServeSettings,
    stop: &'a AtomicBool,
    served: Served,
    period_ns: u64,
    /// What the robot takes to execute and to observe; forgets slowly.
    work_ns: u64,
    /// In the middle of an episode.
    runs: bool,
}

impl Loop<'_> {
    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn episode(&mut self, episode: u64) -> Result<(), ServeError> {
        let failed = |source| ServeError::Robot { episode, source };
        self.robot.reset(episode).map_err(failed)?;
        let (mut executed, mut held) = (ActionValues::default(), false);
        // None before the first answer: until then time stands still.
        let mut due_ns = None;
        let mut succeeded = false;
        for step in 0..=self.settings.steps {
            if let Some(due_ns) = &mut due_ns {
                *due_ns = self.next_tick(*due_ns);
            }
            let begun = Instant::now();
            let flags = self.observe(episode, step, (step > 0).then_some((&executed, held)), due_ns)?;
            self.work(begun.elapsed());
            succeeded |= flags & ObservationFlags::SUCCESS.0 != 0;
            let is_last = flags & ObservationFlags::LAST.0 != 0;
            self.runs = !is_last;
            let answer = match due_ns {
                Some(due_ns) => self.answer_by(due_ns)?,
                None => self.first_answer()?,
            };
            if self.stopped() {
                return Ok(());
            }
            if self.settings.realtime && due_ns.is_none() {
                due_ns = Some(monotonic_ns());
            }
            self.served.observations += 1;
            if is_last {
                break;
            }
            let begun = Instant::now();
            let action;
            (action, held) = self.choose(answer)?;
            executed = self.robot.execute(&action).map_err(failed)?;
            self.guard.executed(&executed).map_err(|why| failed(why.into()))?;
            self.work(begun.elapsed());
        }
        self.served.episodes += 1;
        self.served.successes += u64::from(succeeded);
        Ok(())
    }

    /// Publishes what is seen now, and gives its flags. `before` is what was executed, and whether that was nobody's answer.
    fn observe(
        &mut self,
        episode: u64,
        step: u32,
        before: Option<(&ActionValues, bool)>,
        due_ns: Option<u64>,
    ) -> Result<u32, ServeError> {
        let now_ns = monotonic_ns();
        let period_ns = if self.settings.realtime { self.period_ns } else { 0 };
        let mut observation = self.observation.edit();
        *observation = ObservationHeader {
            sequence: self.served.observations,
            episode,
            step,
            task: crate::tasks::OWN_TASK,
            scheduled_ns: due_ns.unwrap_or(now_ns),
            period_ns,
            ..ObservationHeader::zeroed()
        };
        let cameras = self.link.format().interface().camera.len();
        observation.captured_ns[..cameras].fill(now_ns);
        self.robot.observe(&mut observation).map_err(|source| ServeError::Robot { episode, source })?;
        let executed = match before {
            Some((executed, _)) => *executed,
            None => self.guard.begin(observation.view().state()),
        };
        observation.executed().copy_from_slice(&executed);
        let own = ObservationFlags(observation.flags);
        observation.flags = own
            .with(ObservationFlags::FIRST, step == 0)
            .with(ObservationFlags::ACTION_HELD, before.is_some_and(|(_, held)| held))
            .with(ObservationFlags::LAST, own.contains(ObservationFlags::LAST) || step == self.settings.steps)
            .0;
        if !observation.view().is_finite() {
            return Err(ServeError::NotFinite { episode, step });
        }
        let (flags, reward) = (observation.flags, observation.reward);
        self.served.total_reward += if step == 0 { 0.0 } else { f64::from(reward) };
        self.link.publish_copy(&self.observation)?;
        Ok(flags)
    }

    /// Waits until somebody answers, or `stop`.
    fn first_answer(&mut self) -> Result<Option<Action>, ServeError> {
        let start = Instant::now();
        while !self.stopped() {
            let left = self.settings.timeout.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Err(ServeError::NoAnswer { timeout_s: self.settings.timeout.as_secs_f64() });
            }
            if let Some(answer) = self.wait(left.min(WAIT_SLICE), true)? {
                return Ok(Some(answer));
            }
        }
        Ok(None)
    }

    /// What comes early enough to be executed before the next observation is due.
    fn answer_by(&mut self, due_ns: u64) -> Result<Option<Action>, ServeError> {
        let until_ns = due_ns + self.period_ns.saturating_sub(self.work_ns).max(self.period_ns / 10);
        while !self.stopped() {
            let left = Duration::from_nanos(until_ns.saturating_sub(monotonic_ns()));
            if let Some(answer) = self.wait(left.min(WAIT_SLICE), false)? {
                return Ok(Some(answer));
            }
            if left.is_zero() {
                self.served.missed_answers += 1;
                break;
            }
        }
        Ok(None)
    }

    /// One wait for an answer to the present observation; none does not mean that the time is up. Where time stands still, the observation is
    /// due whenever a controller comes: one that was due long ago is stale to it.
    fn wait(&mut self, timeout: Duration, time_stands_still: bool) -> Result<Option<Action>, ServeError> {
        let misfits = self.link.misfits();
        let (wait, events) = self.link.wait_action(timeout)?;
        self.served.refused += self.link.misfits() - misfits;
        self.served.controllers_left += u64::from(events.closed);
        if events.hello {
            // It has not seen the present observation.
            self.observation.flags |= ObservationFlags::REPEATED.0;
            if time_stands_still {
                self.observation.scheduled_ns = monotonic_ns();
            }
            self.link.publish_copy(&self.observation)?;
        }
        let Wait::Message(action) = wait else { return Ok(None) };
        if action.answers != self.observation.sequence {
            self.served.stale_answers += 1;
            return Ok(None);
        }
        self.served.answers += 1;
        Ok(Some(action))
    }

    /// What is executed, and whether it is nobody's answer.
    fn choose(&mut self, answer: Option<Action>) -> Result<(ActionValues, bool), ServeError> {
        if let Some(answer) = answer {
            match self.guard.accept(&answer.action) {
                Ok(executed) => {
                    self.served.slowed_down += u64::from(executed != answer.action);
                    return Ok((executed, false));
                }
                Err(_) => self.served.refused += 1,
            }
        }
        self.served.rests += 1;
        let rest = self.guard.rest(self.observation.view().state());
        Ok((rest.ok_or(ServeError::NoRest)?, true))
    }

    fn work(&mut self, took: Duration) {
        self.work_ns = (took.as_nanos() as u64).max(self.work_ns - self.work_ns / 16);
    }

    /// Waits for the next tick; ticks that are past are left out and counted.
    fn next_tick(&mut self, due_ns: u64) -> u64 {
        let mut due_ns = due_ns + self.period_ns;
        let behind = monotonic_ns().saturating_sub(due_ns) / self.period_ns;
        self.served.overruns += behind;
        due_ns += behind * self.period_ns;
        while !self.stopped() && monotonic_ns() < due_ns {
            std::thread::sleep(Duration::from_nanos(due_ns - monotonic_ns().min(due_ns)).min(WAIT_SLICE));
        }
        due_ns
    }
}
