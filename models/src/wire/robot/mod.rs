//! A robot of your own on the wire: [`serve`] keeps its time, asks the controller, and looks after what may be executed.
//!
//! In lock-step every observation waits for its answer. In real time an episode begins to run with its first answer: from then on an
//! observation goes out every period of the interface, and a tick without an answer in time executes the interface's safe action. So does an
//! answer that is not finite or out of limits; one of another length is none. All of it is counted. `rcwm.gym` does the same in Python.

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
    /// Goes to where an episode starts. The robot has been given its safe action.
    ///
    /// # Errors
    /// The robot's own.
    fn reset(&mut self, episode: u64) -> Result<(), RobotError>;

    /// Fills in pictures, masks, states, capture stamps, and the reward of the last step; of the flags SUCCESS and MASK_VALID, and LAST
    /// and TERMINAL where the episode ends. All else is filled in already. While an episode has not begun to run, it is asked again and again.
    ///
    /// # Errors
    /// The robot's own.
    fn observe(&mut self, observation: &mut ObservationMut<'_>) -> Result<(), RobotError>;

    /// Begins to execute an action, in the interface's units and within its limits. Gives what is really executed, which may be another.
    /// After the last observation of an episode, and whatever else ends it, that is the safe action.
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
    #[error(
        "no answer within {timeout_s} s ({refused} of another length, {stale} to something else): is a controller running on this instance?"
    )]
    NoAnswer { timeout_s: f64, refused: u64, stale: u64 },
    #[error("the robot measured a number that is not finite at step {step} of episode {episode}")]
    NotFinite { episode: u64, step: u32 },
    #[error(
        "the robot is to hold what is neither commanded nor measured: give the action `measured`, or a safe action"
    )]
    NoRest,
    /// Something ended it, and the safe action failed, too.
    #[error("{cause}; and then the robot could not be brought to rest: {rest}")]
    Unrested { cause: Box<ServeError>, rest: Box<ServeError> },
}

/// Longest wait before `stop` is looked at.
const WAIT_SLICE: Duration = Duration::from_millis(100);
/// Of a period: what a controller is left at least, and by how much an answer may be late.
const SHARE_MIN: u64 = 10;
/// Actions by which a robot comes to rest that may change its command only slowly, at most.
const REST_ACTIONS_MAX: u32 = 200;

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
        moves: false,
    };
    // A panic of the robot's program is caught until both are told, and then goes on.
    let goes_on = |_: &u64| !stop.load(Ordering::Relaxed);
    let served_all =
        || (0..settings.episodes).take_while(goes_on).try_for_each(|episode| loop_.episode(episode));
    let result = catch_unwind(AssertUnwindSafe(served_all));
    // The controller first, then the robot: neither is left with the last command.
    let closed = loop_.link.say_closed();
    let rested = catch_unwind(AssertUnwindSafe(|| loop_.come_to_rest()));
    // What ended the loop comes first.
    match (
        result.unwrap_or_else(|panic| resume_unwind(panic)),
        rested.unwrap_or_else(|panic| resume_unwind(panic)),
    ) {
        (Ok(()), rested) => rested?,
        (Err(cause), Ok(())) => return Err(cause),
        (Err(cause), Err(rest)) => {
            return Err(ServeError::Unrested { cause: cause.into(), rest: rest.into() });
        }
    }
    closed?;
    Ok(loop_.served)
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
    /// What the robot takes to execute; forgets slowly.
    work_ns: u64,
    /// It was given an action since it was last brought to rest.
    moves: bool,
}

/// An observation, as the loop has it.
#[derive(Clone, Copy)]
struct Seen {
    episode: u64,
    step: u32,
    /// What was executed, and whether that was nobody's answer.
    before: Option<(ActionValues, bool)>,
    due_ns: Option<u64>,
}

impl Loop<'_> {
    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn episode(&mut self, episode: u64) -> Result<(), ServeError> {
        self.robot.reset(episode).map_err(|source| ServeError::Robot { episode, source })?;
        let (mut executed, mut held) = (ActionValues::default(), false);
        // None before the first answer: until then time stands still.
        let mut due_ns = None;
        let mut succeeded = false;
        for step in 0..=self.settings.steps {
            if let Some(due_ns) = &mut due_ns {
                *due_ns = self.next_tick(*due_ns);
            }
            let seen = Seen { episode, step, before: (step > 0).then_some((executed, held)), due_ns };
            let flags = self.observe(&seen)?;
            succeeded |= flags & ObservationFlags::SUCCESS.0 != 0;
            let is_last = flags & ObservationFlags::LAST.0 != 0;
            if is_last {
                // Nothing more is answered: whatever moves by its last command would go on.
                self.come_to_rest()?;
            }
            let answer = match due_ns {
                Some(due_ns) => self.answer_by(due_ns)?,
                None => self.first_answer(&seen)?,
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
            let action;
            (action, held) = self.choose(answer)?;
            executed = self.execute(&action, episode)?;
        }
        self.served.episodes += 1;
        self.served.successes += u64::from(succeeded);
        Ok(())
    }

    /// Gives what the robot has made of it, within the limits: beyond them no observation may say that it was.
    fn execute(&mut self, action: &ActionValues, episode: u64) -> Result<ActionValues, ServeError> {
        let begun = Instant::now();
        self.moves = true;
        let failed = |source| ServeError::Robot { episode, source };
        let executed = self.robot.execute(action).map_err(failed)?;
        self.guard.executed(&executed).map_err(|why| failed(why.into()))?;
        let took = begun.elapsed().as_nanos() as u64;
        self.work_ns = took.max(self.work_ns - self.work_ns / 16);
        Ok(self.guard.within(&executed))
    }

    /// The safe action, where the robot may still move by another one; once more as long as it may not change its command at once.
    fn come_to_rest(&mut self) -> Result<(), ServeError> {
        for _ in 0..REST_ACTIONS_MAX {
            if !self.moves {
                break;
            }
            let Some(rest) = self.guard.rest(self.observation.view().state()) else {
                return Err(ServeError::NoRest);
            };
            self.execute(&rest, self.served.episodes)?;
            self.moves = self.guard.still_moves(&rest);
            if self.moves && self.settings.realtime {
                std::thread::sleep(Duration::from_nanos(self.period_ns));
            }
        }
        self.moves = false;
        Ok(())
    }

    /// Publishes what is seen now, and gives its flags.
    fn observe(&mut self, seen: &Seen) -> Result<u32, ServeError> {
        let Seen { episode, step, before, due_ns } = *seen;
        let begun_ns = monotonic_ns();
        let period_ns = if self.settings.realtime { self.period_ns } else { 0 };
        let mut observation = self.observation.edit();
        *observation = ObservationHeader {
            sequence: self.served.observations,
            episode,
            step,
            task: crate::tasks::OWN_TASK,
            period_ns,
            ..ObservationHeader::zeroed()
        };
        let cameras = self.link.format().interface().camera.len();
        observation.captured_ns[..cameras].fill(begun_ns);
        self.robot.observe(&mut observation).map_err(|source| ServeError::Robot { episode, source })?;
        // Before time runs, an observation is due when it is there.
        observation.scheduled_ns = due_ns.unwrap_or_else(monotonic_ns);
        let executed = match before {
            Some((executed, _)) => executed,
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

    /// Waits until somebody answers, or `stop`. A controller passes over what was due long ago: while time stands still in real time, what
    /// is seen is seen and said anew.
    fn first_answer(&mut self, seen: &Seen) -> Result<Option<Action>, ServeError> {
        let start = Instant::now();
        let slice = if self.settings.realtime {
            WAIT_SLICE.min(Duration::from_nanos(self.period_ns))
        } else {
            WAIT_SLICE
        };
        while !self.stopped() {
            let left = self.settings.timeout.saturating_sub(start.elapsed());
            if left.is_zero() {
                let Served { refused, stale_answers: stale, .. } = self.served;
                let timeout_s = self.settings.timeout.as_secs_f64();
                return Err(ServeError::NoAnswer { timeout_s, refused, stale });
            }
            if let Some(answer) = self.wait(left.min(slice))? {
                return Ok(Some(answer));
            }
            if self.settings.realtime {
                self.observe(seen)?;
            }
        }
        Ok(None)
    }

    /// What comes early enough to be executed before the next observation is due.
    fn answer_by(&mut self, due_ns: u64) -> Result<Option<Action>, ServeError> {
        let room_ns = self.period_ns / SHARE_MIN;
        // However late the observation was, a controller gets a moment.
        let until_ns = (due_ns + self.period_ns.saturating_sub(self.work_ns)).max(monotonic_ns() + room_ns);
        while !self.stopped() {
            let left = Duration::from_nanos(until_ns.saturating_sub(monotonic_ns()));
            let answer = self.wait(left.min(WAIT_SLICE))?;
            if answer.is_some() && monotonic_ns() <= until_ns + room_ns {
                return Ok(answer);
            }
            // It came, but this program was stopped meanwhile: it says what was right then.
            if answer.is_some() || left.is_zero() {
                self.served.missed_answers += 1;
                break;
            }
        }
        Ok(None)
    }

    /// One wait for an answer to the present observation; none does not mean that the time is up.
    fn wait(&mut self, timeout: Duration) -> Result<Option<Action>, ServeError> {
        let misfits = self.link.misfits();
        let (wait, events) = self.link.wait_action(timeout)?;
        self.served.refused += self.link.misfits() - misfits;
        self.served.controllers_left += u64::from(events.closed);
        if events.hello {
            // It has not seen the present observation.
            self.observation.flags |= ObservationFlags::REPEATED.0;
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
