//! What the controller is up to, as a pure function: state and event in, state and response out.
//!
//! `docs/controller.md` draws it. Whatever is answered is answered through [`step`], so that its table of tests is the whole
//! behaviour.

use serde::Serialize;

/// What the controller is up to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum State {
    /// Nobody is there to be answered: none has come yet, it has left, or it has been silent for too long. Sends nothing.
    #[default]
    Waiting,
    /// Observations come and the policy answers them.
    Tracking,
    /// Observations are missing, and the policy answers what the world model imagines.
    Imagining {
        /// Imagined ticks in a row.
        ticks: u32,
    },
    /// The policy has nothing valid to send: the fallback is sent.
    Fallback {
        /// Fallback ticks in a row.
        ticks: u32,
        /// Why, as of the last of them.
        cause: Cause,
    },
    /// The policy gave nothing valid for too long. Sends nothing any more; the run ends.
    Stopped {
        /// Why.
        cause: Cause,
    },
}

/// Why the policy has nothing valid to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// No observation came.
    Silence,
    /// An observation held a number that is not finite, or an executed action beyond the limits.
    Observation,
    /// The policy gave a number that is not finite.
    Output,
    /// The engine failed.
    Engine,
    /// The robot's surprise is over its limit: it does not move as expected.
    RobotSurprise,
    /// The environment's surprise is over its limit: the scene is not as expected.
    EnvironmentSurprise,
    /// The surprise of a world model of one branch is over its limit.
    DynamicsSurprise,
}

impl std::fmt::Display for Cause {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Silence => "no observation came",
            Self::Observation => {
                "the observations hold numbers that are not finite, or an executed action beyond the limits"
            }
            Self::Output => "the policy gives numbers that are not finite",
            Self::Engine => "the engine fails",
            Self::RobotSurprise => "the robot's surprise is over its limit",
            Self::EnvironmentSurprise => "the environment's surprise is over its limit",
            Self::DynamicsSurprise => "the world model's surprise is over its limit",
        })
    }
}

/// What has happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A new observation came and the policy decided on it, within all limits.
    Decided,
    /// A new observation came, or one was to be imagined, and there is nothing valid to send.
    Invalid(Cause),
    /// An observation is overdue (real time only).
    Overdue,
    /// The peer has said that it leaves.
    Left,
}

/// What to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Response {
    /// The policy's action.
    Policy,
    /// The policy's action on an imagined frame. Where imagining fails, [`Event::Invalid`] follows.
    Imagine,
    /// The fallback action.
    Fallback,
    Nothing,
}

/// How long the policy is done without.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TickLimits {
    /// Imagined ticks in a row before the fallback.
    pub imagined_ticks_max: u32,
    /// Fallback ticks in a row before the controller falls silent (nobody there) or stops (policy invalid).
    pub fallback_ticks_max: u32,
}

impl Default for TickLimits {
    fn default() -> Self {
        Self { imagined_ticks_max: 5, fallback_ticks_max: 200 }
    }
}

/// The transition.
#[must_use]
pub fn step(state: State, event: Event, limits: TickLimits) -> (State, Response) {
    match (state, event) {
        (State::Stopped { .. }, _) => (state, Response::Nothing),
        (_, Event::Left) => (State::Waiting, Response::Nothing),
        (_, Event::Decided) => (State::Tracking, Response::Policy),
        (State::Waiting, Event::Overdue) => (state, Response::Nothing),
        (State::Tracking, Event::Overdue) => imagine(0, limits),
        (State::Imagining { ticks }, Event::Overdue) => imagine(ticks, limits),
        (State::Fallback { ticks, .. }, Event::Overdue) => fall_back(ticks, Cause::Silence, limits),
        (State::Fallback { ticks, .. }, Event::Invalid(cause)) => fall_back(ticks, cause, limits),
        (_, Event::Invalid(cause)) => fall_back(0, cause, limits),
    }
}

fn imagine(ticks: u32, limits: TickLimits) -> (State, Response) {
    if ticks < limits.imagined_ticks_max {
        (State::Imagining { ticks: ticks + 1 }, Response::Imagine)
    } else {
        fall_back(0, Cause::Silence, limits)
    }
}

fn fall_back(ticks: u32, cause: Cause, limits: TickLimits) -> (State, Response) {
    if ticks < limits.fallback_ticks_max {
        (State::Fallback { ticks: ticks + 1, cause }, Response::Fallback)
    } else if cause == Cause::Silence {
        // Nobody is there to be told anything.
        (State::Waiting, Response::Nothing)
    } else {
        (State::Stopped { cause }, Response::Nothing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: TickLimits = TickLimits { imagined_ticks_max: 2, fallback_ticks_max: 3 };
    const INVALID: [Cause; 5] =
        [Cause::Observation, Cause::Output, Cause::Engine, Cause::RobotSurprise, Cause::EnvironmentSurprise];

    fn imagining(ticks: u32) -> State {
        State::Imagining { ticks }
    }

    fn fallback(ticks: u32, cause: Cause) -> State {
        State::Fallback { ticks, cause }
    }

    fn all_states() -> Vec<State> {
        let mut states = vec![State::Waiting, State::Tracking, imagining(1), imagining(2)];
        for cause in INVALID.into_iter().chain([Cause::Silence]) {
            states.extend((1..=3).map(|ticks| fallback(ticks, cause)));
            states.push(State::Stopped { cause });
        }
        states
    }

    /// Every arrow of the drawing in `docs/controller.md`, once.
    #[test]
    fn every_transition_is_the_drawn_one() {
        use Event::{Decided, Invalid, Left, Overdue};
        use State::{Stopped, Tracking, Waiting};
        let (output, silence) = (Cause::Output, Cause::Silence);
        let table = [
            (Waiting, Decided, Tracking, Response::Policy),
            (Waiting, Invalid(output), fallback(1, output), Response::Fallback),
            (Waiting, Overdue, Waiting, Response::Nothing),
            (Waiting, Left, Waiting, Response::Nothing),
            (Tracking, Decided, Tracking, Response::Policy),
            (Tracking, Invalid(output), fallback(1, output), Response::Fallback),
            (Tracking, Overdue, imagining(1), Response::Imagine),
            (Tracking, Left, Waiting, Response::Nothing),
            (imagining(1), Decided, Tracking, Response::Policy),
            (imagining(1), Invalid(output), fallback(1, output), Response::Fallback),
            (imagining(1), Overdue, imagining(2), Response::Imagine),
            (imagining(2), Overdue, fallback(1, silence), Response::Fallback),
            (imagining(2), Left, Waiting, Response::Nothing),
            (fallback(1, output), Decided, Tracking, Response::Policy),
            (fallback(3, silence), Decided, Tracking, Response::Policy),
            (fallback(1, silence), Overdue, fallback(2, silence), Response::Fallback),
            (fallback(1, output), Overdue, fallback(2, silence), Response::Fallback),
            (fallback(1, silence), Invalid(output), fallback(2, output), Response::Fallback),
            (fallback(3, silence), Overdue, Waiting, Response::Nothing),
            (fallback(3, output), Invalid(output), Stopped { cause: output }, Response::Nothing),
            (fallback(2, output), Left, Waiting, Response::Nothing),
            (Stopped { cause: output }, Decided, Stopped { cause: output }, Response::Nothing),
            (Stopped { cause: output }, Left, Stopped { cause: output }, Response::Nothing),
        ];
        for (state, event, expected, response) in table {
            assert_eq!(step(state, event, LIMITS), (expected, response), "{state:?}, {event:?}");
        }
    }

    #[test]
    fn a_policy_s_action_is_sent_on_its_decision_only_and_leads_to_tracking() {
        for state in all_states() {
            for event in [Event::Overdue, Event::Left].into_iter().chain(INVALID.map(Event::Invalid)) {
                let (next, response) = step(state, event, LIMITS);
                assert!(response != Response::Policy && next != State::Tracking, "{state:?}, {event:?}");
            }
        }
    }

    #[test]
    fn silence_is_borne_for_so_many_ticks_and_no_more() {
        let (mut state, mut sent) = (State::Tracking, Vec::new());
        for _ in 0..10 {
            let (next, response) = step(state, Event::Overdue, LIMITS);
            state = next;
            sent.push(response);
        }
        assert_eq!(state, State::Waiting);
        assert_eq!(sent.iter().filter(|response| **response == Response::Imagine).count(), 2);
        assert_eq!(sent.iter().filter(|response| **response == Response::Fallback).count(), 3);
        assert!(sent[5..].iter().all(|response| *response == Response::Nothing));
    }

    #[test]
    fn every_invalidity_that_lasts_stops_the_controller() {
        for cause in INVALID {
            let mut state = State::Tracking;
            for _ in 0..=LIMITS.fallback_ticks_max {
                state = step(state, Event::Invalid(cause), LIMITS).0;
            }
            assert_eq!(state, State::Stopped { cause });
        }
    }

    #[test]
    fn limits_of_zero_leave_out_what_they_limit() {
        let none = TickLimits { imagined_ticks_max: 0, fallback_ticks_max: 0 };
        let no_imagining = TickLimits { imagined_ticks_max: 0, ..LIMITS };
        let silent = (fallback(1, Cause::Silence), Response::Fallback);
        assert_eq!(step(State::Tracking, Event::Overdue, no_imagining), silent);
        assert_eq!(step(State::Tracking, Event::Overdue, none), (State::Waiting, Response::Nothing));
        let stopped = State::Stopped { cause: Cause::Engine };
        assert_eq!(step(State::Tracking, Event::Invalid(Cause::Engine), none), (stopped, Response::Nothing));
    }
}
