//! A robot with a loop of its own: begin, publish, wait, rest.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::robot::{Guard, ServeError};
use rcwm_models::wire::{Format, ObservationFlags, ObservationHeader, OwnedObservation, SimulatorLink, Wait};

use super::{Linked, Observation, RobotHandle};
use crate::border::{Fill, border, growing, handle, options, slice_mut, zeroed};
use crate::code::{Code, Failure};
use crate::policy::RCWM_ACTION_NUMBERS_MAX;

/// rcwm_answer.kind: the time was up, a signal to the process has cut the wait short, or the controller has left.
pub const RCWM_ANSWER_NONE: u32 = 0;
/// rcwm_answer.kind: an action.
pub const RCWM_ANSWER_ACTION: u32 = 1;

/// rcwm_answer.source: the policy, on what it saw.
pub const RCWM_SOURCE_POLICY: u32 = 0;
/// rcwm_answer.source: the policy, on what its world model has imagined.
pub const RCWM_SOURCE_IMAGINED: u32 = 1;
/// rcwm_answer.source: the controller's fallback.
pub const RCWM_SOURCE_FALLBACK: u32 = 2;

/// What a wait has brought.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Answer {
    /// sizeof(rcwm_answer).
    pub size: usize,
    /// RCWM_ANSWER_NONE or RCWM_ANSWER_ACTION.
    pub kind: u32,
    /// Of an action, where it came from: RCWM_SOURCE_...
    pub source: u32,
    /// Not 0: the controller has said that it leaves. Rest until another comes.
    pub left: u32,
    /// Not 0: changes beyond the interface's rate_max were cut off.
    pub slowed_down: u32,
    /// Answers that this wait has dropped: not finite, out of limits or of another length.
    pub refused: u64,
    /// Answers that this wait has dropped: to an earlier observation.
    pub stale: u64,
    /// Of an action, how many.
    pub numbers: usize,
    /// To be executed: finite, in the interface's units and within its limits.
    pub action: [f32; RCWM_ACTION_NUMBERS_MAX],
}

growing!(Answer, "rcwm_answer", action);

/// Where a loop of the program's own is.
pub(super) struct Own {
    guard: Guard,
    observation: OwnedObservation,
    /// Of the observation that was published last.
    last: Option<Count>,
    /// Between begin and publish.
    begun: bool,
}

#[derive(Clone, Copy)]
struct Count {
    sequence: u64,
    episode: u64,
    step: u32,
    ends_episode: bool,
}

impl Own {
    pub(super) fn new(format: &Arc<Format>) -> Self {
        let (guard, observation) = (Guard::new(format.interface()), OwnedObservation::zeroed(format));
        Self { guard, observation, last: None, begun: false }
    }

    /// Whether the next observation must be the first of an episode.
    fn starts(&self) -> bool {
        self.last.is_none_or(|last| last.ends_episode)
    }

    /// Of the next observation.
    fn next(&self, first: bool) -> Count {
        let (sequence, episode, step) = match self.last {
            None => (0, 0, 0),
            Some(last) if first => (last.sequence + 1, last.episode + 1, 0),
            Some(last) => (last.sequence + 1, last.episode, last.step + 1),
        };
        Count { sequence, episode, step, ends_episode: false }
    }

    fn begin(&mut self, format: &Format) -> Observation {
        let (first, now_ns) = (self.starts(), monotonic_ns());
        let Count { sequence, episode, step, .. } = self.next(first);
        let flags = ObservationFlags::default().with(ObservationFlags::FIRST, first).0;
        let mut message = self.observation.edit();
        *message = ObservationHeader {
            sequence,
            episode,
            step,
            flags,
            scheduled_ns: now_ns,
            ..ObservationHeader::zeroed()
        };
        message.captured_ns[..format.interface().camera.len()].fill(now_ns);
        self.begun = true;
        Observation::of(&mut message)
    }

    fn publish(&mut self, link: &SimulatorLink, filled: &Observation) -> Result<(), Failure> {
        if !self.begun {
            let text = "nothing to publish: call rcwm_robot_begin() and fill in what it gives first";
            return Err(Failure::new(Code::RcwmErrorState, text));
        }
        let flags = ObservationFlags(filled.flags);
        let first = flags.contains(ObservationFlags::FIRST);
        if self.starts() && !first {
            return Err(Failure::argument("the first observation of an episode, without RCWM_FLAG_FIRST"));
        }
        let mut next = self.next(first);
        next.ends_episode = flags.contains(ObservationFlags::LAST);
        let mut message = self.observation.edit();
        filled.give_to(&mut message);
        (message.scheduled_ns, message.period_ns) = (filled.scheduled_ns, filled.period_ns);
        (message.episode, message.step) = (next.episode, next.step);
        if first {
            let executed = self.guard.begin(message.view().state());
            message.executed().copy_from_slice(&executed);
        } else if message.view().has_executable_action() {
            let executed = message.view().executed_action();
            self.guard.executed(&executed).map_err(|why| Failure::argument(format!("executed: {why}")))?;
        } else {
            let executed = message.view().executed_action();
            let text = format!("executed is {executed:?}: not finite, or beyond the interface's limits");
            return Err(Failure::argument(text));
        }
        if !message.view().is_finite() {
            let text = "the observation holds a state or a reward that is not finite";
            return Err(Failure::new(Code::RcwmErrorNotFinite, text));
        }
        link.publish_copy(&self.observation)?;
        (self.last, self.begun) = (Some(next), false);
        Ok(())
    }

    fn wait(&mut self, link: &SimulatorLink, timeout: Duration) -> Result<Answer, Failure> {
        if self.last.is_none() || self.begun {
            let text = "nothing to wait for: publish an observation first";
            return Err(Failure::new(Code::RcwmErrorState, text));
        }
        let mut answer: Answer = zeroed();
        let start = Instant::now();
        loop {
            let misfits = link.misfits();
            let (wait, events) = link.wait_action(timeout.saturating_sub(start.elapsed()))?;
            answer.refused += link.misfits() - misfits;
            answer.left = events.closed.into();
            if events.hello {
                // It has not seen the present observation.
                self.observation.flags |= ObservationFlags::REPEATED.0;
                link.publish_copy(&self.observation)?;
            }
            match wait {
                Wait::Message(action) if action.answers != self.observation.sequence => answer.stale += 1,
                Wait::Message(action) => match self.guard.accept(&action.action) {
                    Err(_) => answer.refused += 1,
                    Ok(accepted) => {
                        // Until its program says what was really executed.
                        self.guard
                            .executed(&accepted)
                            .map_err(|why| Failure::argument(format!("executed: {why}")))?;
                        (answer.kind, answer.source) = (RCWM_ANSWER_ACTION, action.source);
                        answer.slowed_down = (accepted != action.action).into();
                        answer.numbers = accepted.len();
                        answer.action[..accepted.len()].copy_from_slice(&accepted);
                        return Ok(answer);
                    }
                },
                // The time is up, or a signal was taken.
                _ if !events.hello => return Ok(answer),
                _ => {}
            }
            if start.elapsed() >= timeout || events.closed {
                return Ok(answer);
            }
        }
    }
}

/// Begins an observation in a loop of your own: gives the places to be filled, which are good until rcwm_robot_publish(). Sequence,
/// episode and step are counted by the library; RCWM_FLAG_FIRST is set at the first observation, and after one with RCWM_FLAG_LAST.
///
/// In each round: rcwm_robot_begin(); fill in pictures, states, flags, reward, and what was executed since; rcwm_robot_publish();
/// rcwm_robot_wait(); execute the action, or what rcwm_robot_rest() gives where none has come.
///
/// Fails with RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_begin(robot: *mut RobotHandle, observation: *mut Observation) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { link, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: a struct of the caller's, or null.
        let observation = unsafe { Fill::new(observation) }?;
        link.enter(|connected| {
            let Linked { link, own } = connected.get()?;
            observation.with(&own.begin(link.format()));
            Ok(())
        })
    })
}

/// Publishes what rcwm_robot_begin() gave to be filled, and wakes the controller. At the first observation of an episode, what was executed
/// is filled in by the library: positions as they are measured, else zeros.
///
/// Fails with RCWM_ERROR_ARGUMENT (what was executed is no action), RCWM_ERROR_NOT_FINITE (a state or the reward), RCWM_ERROR_STATE or
/// RCWM_ERROR_LINK. But for the last, the observation may be corrected and published again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_publish(
    robot: *mut RobotHandle,
    observation: *const Observation,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { link, .. } = unsafe { handle(robot, "robot") }?;
        if observation.is_null() {
            return Err(Failure::argument(
                "observation is null, expected what rcwm_robot_begin() has filled",
            ));
        }
        // SAFETY: a struct of the caller's.
        let filled = unsafe { options(observation) }?;
        link.enter(|connected| {
            let Linked { link, own } = connected.get()?;
            own.publish(link, &filled)
        })
    })
}

/// Waits for the answer to the observation that was published last; 0 only looks. An answer to an earlier one, one that is not finite, out
/// of limits or of another length is never given; it is counted, and waited on. A controller that comes now gets the observation once more.
///
/// Fails with RCWM_ERROR_LINK, RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT; that no answer comes is no failure: see rcwm_answer.kind.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_wait(
    robot: *mut RobotHandle,
    timeout_ns: u64,
    answer: *mut Answer,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { link, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: a struct of the caller's, or null.
        let answer = unsafe { Fill::new(answer) }?;
        let found = link.enter(|connected| {
            let Linked { link, own } = connected.get()?;
            own.wait(link, Duration::from_nanos(timeout_ns))
        })?;
        answer.with(&found);
        Ok(())
    })
}

/// The interface's safe action for what was measured last: what to execute where no answer has come, and before the robot is closed.
///
/// numbers: as many as an action has. Fails with RCWM_ERROR_ROBOT where the robot is to hold what is neither commanded nor measured,
/// RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_rest(robot: *mut RobotHandle, action: *mut f32, numbers: usize) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { link, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: so many numbers of the caller's, or null.
        let action = unsafe { slice_mut(action, numbers, || "action".into()) }?;
        link.enter(|connected| {
            let Linked { link, own } = connected.get()?;
            let expected = link.format().action_numbers();
            if action.len() != expected {
                let text = format!("action has {} numbers, expected {expected}", action.len());
                return Err(Failure::argument(text));
            }
            let rest = own.guard.rest(own.observation.view().state());
            action.copy_from_slice(&rest.ok_or(ServeError::NoRest)?);
            Ok(())
        })
    })
}
