//! A robot served by callbacks.

use std::ffi::c_void;
use std::time::Duration;

use rcwm_models::wire::robot::{self, Robot, RobotError, ServeSettings};
use rcwm_models::wire::{ActionValues, ObservationMut};

use super::{Connected, Linked, Observation, RobotHandle, closed};
use crate::border::{Fill, border, growing, handle, options};
use crate::code::{Code, Failure, note, noted};

/// The robot's own program. Each gives 0, or anything else where it fails: the robot then gets its safe action by one last `execute`, and
/// rcwm_robot_serve() fails with RCWM_ERROR_ROBOT and the text of rcwm_fail() or of the last call that failed in the callback. They run in
/// the thread that serves. They must return: no C++ exception and no longjmp may leave them (an exception ends the program; rcwm.hpp
/// catches them).
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct RobotCallbacks {
    /// sizeof(rcwm_robot_callbacks).
    pub size: usize,
    /// Handed to each of them.
    pub user: *mut c_void,
    /// Goes to where an episode starts. What was executed last may still be going on.
    pub reset: Option<unsafe extern "C-unwind" fn(user: *mut c_void, episode: u64) -> i32>,
    /// Fills in pictures, masks, states and capture stamps, the reward of the last step, and of the flags SUCCESS, MASK_VALID, LAST and
    /// TERMINAL; all else is there already.
    pub observe: Option<unsafe extern "C-unwind" fn(user: *mut c_void, observation: *mut Observation) -> i32>,
    /// Begins to execute an action, which is finite, in the interface's units and within its limits. `executed` holds the same numbers:
    /// write over them where what is really executed is another action.
    pub execute: Option<
        unsafe extern "C-unwind" fn(
            user: *mut c_void,
            action: *const f32,
            executed: *mut f32,
            numbers: usize,
        ) -> i32,
    >,
}

growing!(RobotCallbacks, "rcwm_robot_callbacks", execute);

/// How a robot is served. Zeros, but for the size, are what is usual.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct ServeOptions {
    /// sizeof(rcwm_serve_options).
    pub size: usize,
    /// 0: until rcwm_robot_stop().
    pub episodes: u64,
    /// Actions an episode, at most; 0: until `observe` sets RCWM_FLAG_LAST.
    pub steps: u32,
    /// Not 0: at the interface's rate. 0: every observation waits for its answer, which only a simulator can.
    pub realtime: u32,
    /// Longest wait for an answer where one is waited for; 0: 60 s.
    pub timeout_s: f64,
}

growing!(ServeOptions, "rcwm_serve_options", timeout_s);

/// What happened.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Served {
    /// sizeof(rcwm_served).
    pub size: usize,
    /// Whole episodes.
    pub episodes: u64,
    /// Episodes with RCWM_FLAG_SUCCESS anywhere.
    pub successes: u64,
    pub total_reward: f64,
    pub observations: u64,
    pub answers: u64,
    /// Answers that were executed with changes beyond the interface's rate_max cut off.
    pub slowed_down: u64,
    /// Answers that were not finite, out of limits or of another length; never executed.
    pub refused: u64,
    /// Answers to an earlier observation; never executed.
    pub stale_answers: u64,
    /// Safe actions.
    pub rests: u64,
    /// Ticks without an answer in time.
    pub missed_answers: u64,
    pub controllers_left: u64,
    /// Ticks that were left out because the robot was late.
    pub overruns: u64,
}

growing!(Served, "rcwm_served", overruns);

impl From<&robot::Served> for Served {
    fn from(served: &robot::Served) -> Self {
        Self {
            size: size_of::<Self>(),
            episodes: served.episodes,
            successes: served.successes,
            total_reward: served.total_reward,
            observations: served.observations,
            answers: served.answers,
            slowed_down: served.slowed_down,
            refused: served.refused,
            stale_answers: served.stale_answers,
            rests: served.rests,
            missed_answers: served.missed_answers,
            controllers_left: served.controllers_left,
            overruns: served.overruns,
        }
    }
}

/// The callbacks as the loop calls them.
struct Driver {
    user: *mut c_void,
    reset: unsafe extern "C-unwind" fn(*mut c_void, u64) -> i32,
    observe: unsafe extern "C-unwind" fn(*mut c_void, *mut Observation) -> i32,
    execute: unsafe extern "C-unwind" fn(*mut c_void, *const f32, *mut f32, usize) -> i32,
}

impl Driver {
    fn of(callbacks: RobotCallbacks) -> Result<Self, Failure> {
        let RobotCallbacks { user, reset, observe, execute, .. } = callbacks;
        let missing = |what| Failure::argument(format!("callbacks.{what} is null, expected a function"));
        Ok(Self {
            user,
            reset: reset.ok_or_else(|| missing("reset"))?,
            observe: observe.ok_or_else(|| missing("observe"))?,
            execute: execute.ok_or_else(|| missing("execute"))?,
        })
    }
}

/// Calls the program; where it fails, its words are those that were noted in the meantime.
fn call(callback: &str, of: impl FnOnce() -> i32) -> Result<(), RobotError> {
    note("");
    match of() {
        0 => Ok(()),
        code => match noted() {
            text if text.is_empty() => Err(format!("{callback} has given {code}").into()),
            text => Err(text.into()),
        },
    }
}

impl Robot for Driver {
    fn reset(&mut self, episode: u64) -> Result<(), RobotError> {
        // SAFETY: the program's own function, with what it asked for.
        call("reset", || unsafe { (self.reset)(self.user, episode) })
    }

    fn observe(&mut self, observation: &mut ObservationMut<'_>) -> Result<(), RobotError> {
        let mut places = Observation::of(observation);
        // SAFETY: the program's own function; the places are good until it returns.
        call("observe", || unsafe { (self.observe)(self.user, &raw mut places) })?;
        places.give_to(observation);
        Ok(())
    }

    fn execute(&mut self, action: &ActionValues) -> Result<ActionValues, RobotError> {
        let mut executed = *action;
        let (from, to) = (action.as_ptr(), executed.as_mut_ptr());
        // SAFETY: the program's own function; both hold that many numbers.
        call("execute", || unsafe { (self.execute)(self.user, from, to, action.len()) })?;
        Ok(executed)
    }
}

/// Serves whole episodes, or until rcwm_robot_stop(), in the calling thread. It keeps the interface's rate, waits for controllers and
/// outlives them, and takes a last look at every answer: one that is not finite, out of limits or of another length is never executed,
/// changes beyond rate_max are cut off, and a tick without an answer executes the interface's safe action. However it ends, the controller
/// is told first and the robot gets its safe action. The link is then closed, and of the robot's functions only rcwm_robot_close() is left.
///
/// options: null for what is usual. served: what happened, filled in where it succeeds; may be null.
/// Fails with RCWM_ERROR_ROBOT, RCWM_ERROR_NOT_FINITE (the robot measured such a number), RCWM_ERROR_NO_ANSWER, RCWM_ERROR_LINK,
/// RCWM_ERROR_STATE or RCWM_ERROR_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_serve(
    robot: *mut RobotHandle,
    callbacks: *const RobotCallbacks,
    options: *const ServeOptions,
    served: *mut Served,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { stop, link, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: a struct of the caller's, or null.
        let mut driver = Driver::of(unsafe { self::options(callbacks) }?)?;
        // SAFETY: a struct of the caller's, or null.
        let settings = serve_settings(unsafe { self::options(options) }?)?;
        // SAFETY: a struct of the caller's.
        let served = (!served.is_null()).then(|| unsafe { Fill::new(served) }).transpose()?;
        let found = link.enter(|Connected(link)| {
            let Linked { link, .. } = link.take().ok_or_else(closed)?;
            Ok(robot::serve(&mut driver, link, &settings, stop)?)
        })?;
        if let Some(served) = served {
            served.with(&(&found).into());
        }
        Ok(())
    })
}

fn serve_settings(options: ServeOptions) -> Result<ServeSettings, Failure> {
    let ServeOptions { episodes, steps, realtime, timeout_s, .. } = options;
    let timeout_s = if timeout_s == 0.0 { 60.0 } else { timeout_s };
    let wrong = |_| Failure::argument(format!("timeout_s = {timeout_s}, expected seconds, 0 for 60"));
    Ok(ServeSettings {
        episodes: if episodes == 0 { u64::MAX } else { episodes },
        steps: if steps == 0 { u32::MAX } else { steps },
        realtime: realtime != 0,
        timeout: Duration::try_from_secs_f64(timeout_s).map_err(wrong)?,
    })
}
