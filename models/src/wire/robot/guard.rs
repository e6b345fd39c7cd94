//! What a robot may execute, whoever commands it: a last look on the robot's own side.

use crate::interface::{ActionNumber, Interface, Safe};
use crate::wire::ActionValues;

/// Holds what was executed last; all actions are in the interface's units. What is chosen counts only once it was [executed](Self::executed).
#[derive(Debug, Clone)]
pub struct Guard {
    numbers: Vec<ActionNumber>,
    /// NaN where it is not known: a position that is not measured, before the first command.
    last: ActionValues,
    /// Something was executed in this episode.
    commanded: bool,
}

/// Why an answer is not executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    #[error("not finite")]
    NotFinite,
    #[error("out of limits")]
    OutOfLimits,
    #[error("of another length")]
    Length,
}

/// By how much of its range an answer may be beyond a limit and count as rounded.
const ROUNDING: f64 = 1e-6;

impl Guard {
    #[must_use]
    pub fn new(interface: &Interface) -> Self {
        let numbers = interface.numbers();
        Self { last: ActionValues::zeros(numbers.len()), numbers, commanded: false }
    }

    /// Begins an episode: what counts as executed before it. Zeros, or a position as it is measured; all zeros where that is not known,
    /// which says that nothing was executed.
    pub fn begin(&mut self, state: &[f32]) -> ActionValues {
        self.commanded = false;
        self.last = self.each(|number| match measured(number, state) {
            Some(measured) if number.is_absolute => measured.clamp(number.low, number.high),
            _ if number.is_absolute => f32::NAN,
            _ => 0.0_f32.clamp(number.low, number.high),
        });
        if self.last.is_finite() { self.last } else { ActionValues::zeros(self.last.len()) }
    }

    /// What is to be executed of an answer: itself, changed by no more than `rate_max`.
    ///
    /// # Errors
    /// Why nothing of it is.
    pub fn accept(&self, action: &[f32]) -> Result<ActionValues, Refused> {
        if action.len() != self.numbers.len() {
            return Err(Refused::Length);
        }
        if !action.iter().all(|x| x.is_finite()) {
            return Err(Refused::NotFinite);
        }
        let is_near = |(number, x): (&ActionNumber, &f32)| {
            let (x, low, high) = (f64::from(*x), f64::from(number.low), f64::from(number.high));
            let room = ROUNDING * (high - low);
            (low - room..=high + room).contains(&x)
        };
        if !self.numbers.iter().zip(action).all(is_near) {
            return Err(Refused::OutOfLimits);
        }
        Ok(ActionValues::from_fn(action.len(), |at| {
            // Limits come last: a robot may have been moved beyond them.
            self.near(at, action[at]).clamp(self.numbers[at].low, self.numbers[at].high)
        }))
    }

    /// No farther from what was executed last than may be.
    fn near(&self, at: usize, wanted: f32) -> f32 {
        let (last, most) = (self.last[at], self.numbers[at].rate_max);
        if last.is_nan() { wanted } else { wanted.clamp(last - most, last + most) }
    }

    /// The interface's safe action for a measured state; none where it is to hold what is not known. A place to drive to is driven to no
    /// faster than `rate_max`.
    #[must_use]
    pub fn rest(&self, state: &[f32]) -> Option<ActionValues> {
        let held = |at: usize| if self.commanded { self.last[at] } else { f32::NAN };
        let safe = |(at, number): (usize, &ActionNumber)| match number.safe {
            Safe::Number(safe) => self.near(at, safe),
            Safe::Hold if self.commanded => self.last[at],
            // What was executed last is the next best.
            Safe::Hold | Safe::HoldMeasured => measured(number, state).unwrap_or_else(|| held(at)),
        };
        let rest: ActionValues = self.numbers.iter().enumerate().map(safe).collect();
        rest.is_finite().then(|| self.within(&rest))
    }

    /// Whether a robot that has executed this still moves by its last command: a change or a velocity on its way to rest.
    #[must_use]
    pub fn still_moves(&self, action: &ActionValues) -> bool {
        let moves = |(number, x): (&ActionNumber, &f32)| match number.safe {
            Safe::Number(safe) => !number.is_absolute && *x != safe.clamp(number.low, number.high),
            Safe::Hold | Safe::HoldMeasured => false,
        };
        self.numbers.iter().zip(action.iter()).any(moves)
    }

    /// The same within the limits.
    #[must_use]
    pub fn within(&self, action: &ActionValues) -> ActionValues {
        self.numbers.iter().zip(action.iter()).map(|(number, x)| x.clamp(number.low, number.high)).collect()
    }

    /// What the robot has made of the action that it was given.
    ///
    /// # Errors
    /// Why it is no action.
    pub fn executed(&mut self, action: &ActionValues) -> Result<(), Refused> {
        if action.len() != self.numbers.len() {
            return Err(Refused::Length);
        }
        if !action.is_finite() {
            return Err(Refused::NotFinite);
        }
        (self.last, self.commanded) = (*action, true);
        Ok(())
    }

    fn each(&self, of: impl Fn(&ActionNumber) -> f32) -> ActionValues {
        self.numbers.iter().map(of).collect()
    }
}

fn measured(number: &ActionNumber, state: &[f32]) -> Option<f32> {
    number.measured.and_then(|at| state.get(at).copied()).filter(|x| x.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two joints in radians, measured, by no more than 0.05 a step.
    fn arm() -> Guard {
        Guard::new(&Interface::parse(include_str!("../../interface/arm.toml")).unwrap())
    }

    #[test]
    fn an_arm_starts_from_where_it_is_measured_and_moves_no_faster_than_it_may() {
        let mut guard = arm();
        assert_eq!(guard.begin(&[0.5, -0.25]), [0.5, -0.25]);
        let first = guard.accept(&[1.0, -0.26]).unwrap();
        assert_eq!(first, [0.55, -0.26]);
        guard.executed(&first).unwrap();
        assert_eq!(guard.accept(&[0.56, -0.26]).unwrap(), [0.56, -0.26]);
    }

    #[test]
    fn limits_come_last_where_a_robot_stands_beyond_them() {
        let mut guard = arm();
        guard.begin(&[0.0, 0.0]);
        guard.executed(&[0.0, 1.9].into()).unwrap();
        assert_eq!(guard.accept(&[0.0, 1.6]).unwrap(), [0.0, 1.7]);
    }

    #[test]
    fn what_is_no_action_of_this_robot_is_not_executed() {
        let mut guard = arm();
        guard.begin(&[0.0, 0.0]);
        assert_eq!(guard.accept(&[0.0]), Err(Refused::Length));
        assert_eq!(guard.accept(&[f32::NAN, 0.0]), Err(Refused::NotFinite));
        assert_eq!(guard.accept(&[0.0, 1.8]), Err(Refused::OutOfLimits));
        // It counts as executed nothing.
        assert_eq!(guard.accept(&[0.04, 0.0]).unwrap(), [0.04, 0.0]);
    }

    #[test]
    fn it_rests_where_the_interface_says() {
        let mut guard = arm();
        guard.begin(&[0.0, 0.0]);
        guard.executed(&[0.05, 0.05].into()).unwrap();
        assert_eq!(guard.rest(&[0.03, 0.02]).unwrap(), [0.03, 0.02]);
        assert_eq!(guard.rest(&[f32::NAN, 0.01]).unwrap(), [0.05, 0.01], "what is not measured now");
        assert!(arm().rest(&[f32::NAN, 0.0]).is_none(), "what is not known cannot be held");
        let mut hand = Guard::new(&Interface::metaworld());
        hand.begin(&[0.0; 18]);
        hand.executed(&[0.5; 4].into()).unwrap();
        assert_eq!(hand.rest(&[0.0; 18]).unwrap(), [0.0; 4]);
    }

    /// One number from -2 to 2 with a fallback of its own, measured.
    fn one(mode: &str, fallback: &str) -> Guard {
        let text = format!(
            "[interface]\nname = \"one\"\nrate_hz = 40.0\n[[interface.state]]\nname = \"at\"\nkind = \"state/joint/{what}\"\n\
             elements = [\"j\"]\nunit = \"{unit}\"\n[[interface.camera]]\nname = \"front\"\nshape = [64, 64, 3]\nencoding = \"rgb8\"\n\
             [[interface.action]]\nname = \"arm\"\nkind = \"command/joint/{what}\"\nmode = \"{mode}\"\nelements = [\"j\"]\n\
             unit = \"{unit}\"\nlow = [-2.0]\nhigh = [2.0]\nrate_max = 0.25\nmeasured = \"at\"\nfallback = {fallback}\n",
            what = if mode == "velocity" { "velocity" } else { "position" },
            unit = if mode == "velocity" { "rad/s" } else { "rad" },
        );
        Guard::new(&Interface::parse(&text).unwrap())
    }

    #[test]
    fn what_holds_a_change_or_a_velocity_stands_still() {
        for mode in ["delta", "velocity"] {
            let mut guard = one(mode, "\"hold\"");
            guard.begin(&[1.0]);
            assert_eq!(guard.rest(&[1.0]).unwrap(), [0.0], "{mode}: nothing was commanded");
            guard.executed(&[1.5].into()).unwrap();
            assert_eq!(
                guard.rest(&[1.0]).unwrap(),
                [1.25],
                "{mode}: on its way to 0, by no more than rate_max"
            );
        }
    }

    #[test]
    fn a_safe_place_is_driven_to_no_faster_than_may_be() {
        let mut guard = one("absolute", "[0.0]");
        guard.begin(&[1.0]);
        guard.executed(&[1.25].into()).unwrap();
        assert_eq!(guard.rest(&[1.2]).unwrap(), [1.0]);
    }

    #[test]
    fn what_a_robot_would_not_execute_is_not_held() {
        let mut guard = one("absolute", "\"hold\"");
        guard.begin(&[1.0]);
        guard.executed(&[1.0].into()).unwrap();
        guard.accept(&[1.2]).unwrap();
        assert_eq!(guard.rest(&[1.1]).unwrap(), [1.0], "it failed, and 1.2 was never executed");
    }
}
