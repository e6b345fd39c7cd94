//! The last thing that happens to an action, whoever decided it: finite, not too far from what was executed before, and within the limits.

use std::str::FromStr;

use rcwm_models::interface::Safe;
use rcwm_models::wire::{ActionValues, Observation, ObservationFlags};
use serde::{Deserialize, Serialize};

use crate::policy::ActionLimits;

/// What is sent when the policy has nothing valid to send.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[expect(clippy::large_enum_variant, reason = "copied by a loop that must not allocate")]
pub enum Fallback {
    /// What the interface says of each action: hold, what was measured, zero, or numbers.
    Interface,
    /// The action that the robot executed last, or was sent last if that is later.
    Hold,
    /// Zeros: no motion where actions are displacements or velocities, the gripper half closed. Holds where they are positions.
    Zero,
    /// This action.
    Given(ActionValues),
}

impl FromStr for Fallback {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "interface" => return Ok(Self::Interface),
            "hold" => return Ok(Self::Hold),
            "zero" => return Ok(Self::Zero),
            _ => {}
        }
        let values: Result<Vec<f32>, _> = text.split(',').map(|value| value.trim().parse()).collect();
        match values.ok().and_then(|values| ActionValues::of(&values)) {
            Some(action) if action.is_finite() => Ok(Self::Given(action)),
            _ => {
                Err("expected interface, hold, zero, or the finite numbers of an action as in 0,0,0,-1"
                    .into())
            }
        }
    }
}

/// What has passed the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passed {
    /// The action, fit to be sent.
    pub action: ActionValues,
    /// It was not finite, and is the held action instead.
    pub was_not_finite: bool,
    /// The rate limit has changed it.
    pub rate_limited: bool,
}

/// Makes every action fit, and knows what the robot does without a new one.
#[derive(Debug, Clone, Copy)]
pub struct SafetyFilter {
    limits: ActionLimits,
    /// Beside that of the limits, as a share of half of each number's range.
    rate_max: Option<f32>,
    /// What the robot executes as far as is known: executed as the last observation says, or sent since.
    held: Option<ActionValues>,
    /// What was sent last in this episode.
    sent: Option<ActionValues>,
    /// What was measured last of what each number moves; NaN where nothing is.
    measured: Option<ActionValues>,
}

impl SafetyFilter {
    /// A safety filter with the limits of a bundle; with `rate_max`, no number moves by more than that share of half of its range from
    /// what was executed last.
    #[must_use]
    pub fn new(limits: ActionLimits, rate_max: Option<f32>) -> Self {
        // Written so that NaN allows no motion.
        let rate_max = rate_max.map(|rate_max| rate_max.max(0.0));
        Self { limits, rate_max, held: None, sent: None, measured: None }
    }

    /// Another policy, with limits of its own. What was executed and sent was executed and sent.
    pub fn take_limits(&mut self, limits: ActionLimits) {
        self.limits = limits;
    }

    /// A new observation, the first of an episode or where the controller joined one: takes over what the robot has executed. An
    /// observation that is refused tells nothing, unless nothing else is known.
    pub fn observed(&mut self, observation: &Observation<'_>, is_first: bool) {
        let starts = observation.is(ObservationFlags::FIRST);
        if is_first {
            self.sent = None;
            if self.limits.absolute == 0 && starts {
                // A motion ends with its episode; a position is held. Where the first observation was lost, or the controller has
                // joined another publisher, nothing says that the robot rests.
                self.held = None;
            }
        }
        if observation.is_valid() {
            self.measured = measured(observation);
        }
        let executed = observation.executed_action();
        if observation.is_valid() || (self.held.is_none() && observation.has_executable_action()) {
            // Zeros at a first observation say that nothing was executed, which is no position.
            let says_nothing = starts && executed.iter().all(|x| *x == 0.0);
            self.held = if says_nothing { self.at_rest() } else { Some(executed) };
        }
    }

    /// Where nothing was executed yet: no motion, and each position as it was measured, or held before; none where one of them is not known.
    fn at_rest(&self) -> Option<ActionValues> {
        let position = |i: usize| {
            let measured = self.measured.map(|measured| measured[i]).filter(|x| x.is_finite());
            measured.or(self.held.map(|held| held[i]))
        };
        let number = |i: usize| if self.limits.is_absolute(i) { position(i) } else { Some(0.0) };
        (0..self.limits.numbers()).map(number).collect()
    }

    /// What the robot goes on with when nothing else is sent: what it executed last. Before anything is known, no motion; none where
    /// zeros are not that.
    #[must_use]
    pub fn held(&self) -> Option<ActionValues> {
        let rest = (self.limits.absolute == 0).then(|| ActionValues::zeros(self.limits.numbers()));
        self.held.or(rest)
    }

    /// The fallback's action; none where there is nothing to hold.
    #[must_use]
    pub fn fallback(&self, fallback: Fallback) -> Option<ActionValues> {
        match fallback {
            Fallback::Hold => self.held(),
            Fallback::Zero => self.held().map(|held| {
                let rest = |i: usize| if self.limits.is_absolute(i) { held[i] } else { 0.0 };
                ActionValues::from_fn(held.len(), rest)
            }),
            Fallback::Interface => (0..self.limits.numbers()).map(|i| self.safe(i)).collect(),
            Fallback::Given(action) => Some(action),
        }
    }

    /// What the interface says of one number; what was measured is held where there is such a thing.
    fn safe(&self, i: usize) -> Option<f32> {
        let held = || self.held().map(|held| held[i]);
        match self.limits.safe[i] {
            Safe::Number(number) => Some(number),
            Safe::Hold => held(),
            Safe::HoldMeasured => {
                self.measured.map(|measured| measured[i]).filter(|x| x.is_finite()).or_else(held)
            }
        }
    }

    /// The action that may be sent in place of `action`; none where it is not finite and there is nothing to hold.
    #[must_use]
    pub fn pass(&self, action: ActionValues) -> Option<Passed> {
        let was_not_finite = action.iter().any(|x| !x.is_finite());
        let wanted = if was_not_finite { self.held()? } else { action };
        let limited = self.limit_rate(wanted);
        // Last, whatever was executed: the limits may be narrower than those that it was within.
        let action = self.limits.clamp(limited);
        Some(Passed { action, was_not_finite, rate_limited: limited != wanted })
    }

    fn limit_rate(&self, action: ActionValues) -> ActionValues {
        let Some(held) = self.held() else { return action };
        // What was sent last may be executed only after the observation that is answered now: near it too, where that is possible.
        let sent = self.sent.unwrap_or(held);
        ActionValues::from_fn(action.len(), |i| {
            let given = self.rate_max.map_or(f32::INFINITY, |share| share * self.limits.half_range[i]);
            let rate_max = self.limits.rate_max[i].min(given);
            if rate_max == f32::INFINITY {
                return action[i];
            }
            let (low, high) = (held[i] - rate_max, held[i] + rate_max);
            let (low_of_both, high_of_both) = (low.max(sent[i] - rate_max), high.min(sent[i] + rate_max));
            if low_of_both <= high_of_both {
                action[i].clamp(low_of_both, high_of_both)
            } else {
                action[i].clamp(low, high)
            }
        })
    }

    /// The action was sent.
    pub fn sent(&mut self, action: ActionValues) {
        (self.held, self.sent) = (Some(action), Some(action));
    }
}

/// What the robot says of where each number of an action is; NaN where its interface names no state for it.
fn measured(observation: &Observation<'_>) -> Option<ActionValues> {
    let robot = observation.format().interface();
    if robot.action.iter().all(|action| action.measured.is_none()) {
        return None;
    }
    let state = observation.state();
    let of = |action: &rcwm_models::interface::Action, at: usize| {
        let range = action.measured.as_deref().and_then(|name| robot.state_range(name));
        range.and_then(|range| state.get(range.start + at).copied()).unwrap_or(f32::NAN)
    };
    let each =
        robot.action.iter().flat_map(|action| (0..action.elements.len()).map(move |at| of(action, at)));
    Some(each.collect())
}

#[cfg(test)]
mod tests;
