//! The last thing that happens to an action, whoever decided it: finite, within the limits, and not too far from the one before.

use std::str::FromStr;

use rcwm_models::ACTION_LEN;
use serde::{Deserialize, Serialize};

use crate::policy::ActionLimits;

/// What is sent when the policy has nothing fit to send.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fallback {
    /// The last action that was sent in this episode; zeros before the first.
    Hold,
    /// Zeros: no motion, the gripper half closed.
    Zero,
    /// This action.
    Given([f32; ACTION_LEN]),
}

impl Fallback {
    /// The action, after `last` was sent in this episode.
    #[must_use]
    pub fn action(self, last: Option<[f32; ACTION_LEN]>) -> [f32; ACTION_LEN] {
        match self {
            Self::Hold => last.unwrap_or_default(),
            Self::Zero => [0.0; ACTION_LEN],
            Self::Given(action) => action,
        }
    }
}

impl FromStr for Fallback {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "hold" => return Ok(Self::Hold),
            "zero" => return Ok(Self::Zero),
            _ => {}
        }
        let values: Result<Vec<f32>, _> = text.split(',').map(|value| value.trim().parse()).collect();
        let action: Option<[f32; ACTION_LEN]> = values.ok().and_then(|values| values.try_into().ok());
        match action {
            Some(action) if action.iter().all(|x| x.is_finite()) => Ok(Self::Given(action)),
            _ => Err(format!("expected hold, zero, or {ACTION_LEN} finite numbers as in 0,0,0,-1")),
        }
    }
}

/// What has passed the gate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passed {
    /// The action, fit to be sent.
    pub action: [f32; ACTION_LEN],
    /// It was not finite, and is the fallback of zeros instead.
    pub was_not_finite: bool,
    /// The rate limit has changed it.
    pub rate_limited: bool,
}

/// Makes every action fit.
#[derive(Debug, Clone, Copy)]
pub struct Gate {
    limits: ActionLimits,
    rate_max: Option<f32>,
    last: Option<[f32; ACTION_LEN]>,
}

impl Gate {
    /// A gate with the bundle's limits; with `rate_max`, no component moves by more than that from one action to the next.
    #[must_use]
    pub fn new(limits: ActionLimits, rate_max: Option<f32>) -> Self {
        // Written so that NaN allows no motion.
        Self { limits, rate_max: rate_max.map(|rate_max| rate_max.max(0.0)), last: None }
    }

    /// Another policy, with limits of its own. What was sent last was sent.
    pub fn take_limits(&mut self, limits: ActionLimits) {
        self.limits = limits;
    }

    /// The last action sent in this episode.
    #[must_use]
    pub fn last(&self) -> Option<[f32; ACTION_LEN]> {
        self.last
    }

    /// Another episode: the robot is at rest.
    pub fn start_episode(&mut self) {
        self.last = None;
    }

    /// The action that may be sent in place of `action`.
    #[must_use]
    pub fn pass(&self, action: [f32; ACTION_LEN]) -> Passed {
        let was_not_finite = action.iter().any(|x| !x.is_finite());
        let clamped = self.limits.clamp(if was_not_finite { [0.0; ACTION_LEN] } else { action });
        let limited = self.limit_rate(clamped);
        Passed { action: limited, was_not_finite, rate_limited: limited != clamped }
    }

    fn limit_rate(&self, action: [f32; ACTION_LEN]) -> [f32; ACTION_LEN] {
        let Some(rate_max) = self.rate_max else { return action };
        // At rest is no motion, or what the limits allow that is nearest to it.
        let last = self.last.unwrap_or_else(|| self.limits.clamp([0.0; ACTION_LEN]));
        // Between two actions within the limits, so that it stays within them.
        std::array::from_fn(|i| action[i].clamp(last[i] - rate_max, last[i] + rate_max))
    }

    /// The action was sent.
    pub fn sent(&mut self, action: [f32; ACTION_LEN]) {
        self.last = Some(action);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: ActionLimits = ActionLimits { low: [-1.0, -1.0, 0.2, -1.0], high: [1.0, 0.5, 1.0, 1.0] };

    fn send(gate: &mut Gate, action: [f32; ACTION_LEN]) -> Passed {
        let passed = gate.pass(action);
        gate.sent(passed.action);
        passed
    }

    #[test]
    fn what_is_not_finite_becomes_zeros_within_the_limits() {
        let gate = Gate::new(LIMITS, None);
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let passed = gate.pass([0.5, bad, 0.5, 0.5]);
            assert_eq!((passed.action, passed.was_not_finite), ([0.0, 0.0, 0.2, 0.0], true));
        }
        assert!(!gate.pass([9.0; 4]).was_not_finite);
    }

    #[test]
    fn no_component_moves_faster_than_the_rate_limit_and_all_stay_within_the_limits() {
        let mut gate = Gate::new(LIMITS, Some(0.3));
        let mut last = [0.0, 0.0, 0.2, 0.0];
        for wanted in [[9.0; 4], [9.0; 4], [-9.0; 4], [f32::NAN; 4], [-9.0; 4], [0.1, 0.1, 0.3, 0.1]] {
            let action = send(&mut gate, wanted).action;
            for i in 0..ACTION_LEN {
                assert!((action[i] - last[i]).abs() <= 0.3 + 1e-6, "{action:?} after {last:?}");
                assert!((LIMITS.low[i]..=LIMITS.high[i]).contains(&action[i]), "{action:?}");
            }
            last = action;
        }
    }

    #[test]
    fn an_episode_starts_from_rest_and_what_was_not_sent_does_not_count() {
        let mut gate = Gate::new(LIMITS, Some(0.5));
        send(&mut gate, [1.0; 4]);
        assert_eq!(gate.pass([1.0; 4]).action, [1.0, 0.5, 1.0, 1.0]);
        assert_eq!(gate.last().unwrap(), [0.5, 0.5, 0.7, 0.5]);
        gate.start_episode();
        assert_eq!(gate.pass([1.0; 4]).action, [0.5, 0.5, 0.7, 0.5]);
        assert!(!gate.pass([0.1, 0.1, 0.3, 0.1]).rate_limited);
    }

    #[test]
    fn fallbacks_are_named_or_given() {
        let last = Some([0.1, 0.2, 0.3, 0.4]);
        assert_eq!("hold".parse::<Fallback>().unwrap().action(last), [0.1, 0.2, 0.3, 0.4]);
        assert_eq!("hold".parse::<Fallback>().unwrap().action(None), [0.0; 4]);
        assert_eq!("zero".parse::<Fallback>().unwrap().action(last), [0.0; 4]);
        assert_eq!("0, 0,0.5,-1".parse::<Fallback>().unwrap().action(last), [0.0, 0.0, 0.5, -1.0]);
        for bad in ["", "stop", "1,2,3", "1,2,3,4,5", "0,0,0,NaN", "0,0,0,inf"] {
            assert!(bad.parse::<Fallback>().is_err(), "{bad:?}");
        }
    }
}
