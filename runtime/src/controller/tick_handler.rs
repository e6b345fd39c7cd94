//! One tick: with an observation, or without one.

use rcwm_models::bundle::PartName;
use rcwm_models::wire::{
    Action, ActionSource, ActionValues, Observation, ObservationFlags, ObservationSample,
};

use super::{
    Arrival, Cause, Controller, ControllerError, EpisodeResult, Event, Response, State, Taken, Tick,
    TickObserver, TickTimes, step,
};
use crate::pacing::Stamps;
use crate::policy::{Decision, PolicyError};
use crate::swap::Moment;
use crate::telemetry::Stage;

/// What to send, and where it comes from; no action where nothing is known that could be held.
type Chosen = (ActionSource, Option<ActionValues>);

/// A tick on its way to the observers.
struct Ticked<'a> {
    observation: Option<&'a Observation<'a>>,
    is_first: bool,
    rewound: bool,
    decision: Option<Decision>,
    answer: Action,
    overtaken: bool,
    times: TickTimes,
}

impl Controller {
    /// Takes an observation.
    pub(super) fn take(
        &mut self,
        sample: &ObservationSample,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<Taken, ControllerError> {
        let observation = &sample.view();
        let received_ns = self.link.now_ns();
        self.counters.clock_ahead += u64::from(Stamps::of(observation, received_ns).ahead_ns > 0);
        if self.pacing.is_stale(observation, received_ns) {
            self.counters.note(Arrival::Stale);
            return Ok(Taken::Nothing);
        }
        let arrival = self.tracker.place(sample.origin(), observation.sequence, observation.episode);
        self.counters.note(arrival);
        match arrival {
            Arrival::Stale => Ok(Taken::Nothing),
            Arrival::Repeated => self.answer_again(observation, received_ns),
            Arrival::Joined { .. } => self.answer_new(observation, true, received_ns, observers),
            Arrival::Next { new_episode, .. } => {
                let is_first = new_episode || observation.is(ObservationFlags::FIRST);
                self.answer_new(observation, is_first, received_ns, observers)
            }
        }
    }

    /// Answers the last observation as before. One that is marked as repeated says that the peer still stands there, whatever was
    /// imagined since: our answer was lost, or overwritten by one to a tick that the peer has not reached.
    fn answer_again(
        &mut self,
        observation: &Observation<'_>,
        received_ns: u64,
    ) -> Result<Taken, ControllerError> {
        let sequence = observation.sequence;
        let Some(own) = self.own_answer.filter(|own| own.answers == sequence) else {
            return Ok(Taken::Again);
        };
        let went_on = self.answer.is_some_and(|answer| answer.answers != sequence);
        if went_on && !observation.is(ObservationFlags::REPEATED) {
            return Ok(Taken::Nothing);
        }
        // A tick may also have been imagined and its answer not been sent, as this observation was found meanwhile.
        let rewound =
            observation.is(ObservationFlags::REPEATED) && self.rewind(sequence.saturating_add(1), false);
        if went_on {
            self.filter.observed(observation, false);
        }
        let source = ActionSource::from_wire(own.source).unwrap_or(ActionSource::Fallback);
        if source == ActionSource::Policy {
            self.state = step(self.state, Event::Decided, self.settings.ticks).0;
        }
        self.pacing.observed(observation, received_ns);
        if self.is_overtaken(observation, received_ns)? {
            return Ok(Taken::Again);
        }
        let answer = self.send(sequence, source, Some(own.action))?;
        if answer.published_ns > 0 {
            // Where the safety filter has changed it, since the robot stands elsewhere by now, this is what is the same from here on.
            self.own_answer = Some(answer);
        }
        if went_on || rewound {
            self.work_ahead((!observation.is(ObservationFlags::LAST)).then_some(&answer.action));
        }
        Ok(Taken::Again)
    }

    fn answer_new(
        &mut self,
        observation: &Observation<'_>,
        is_first: bool,
        received_ns: u64,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<Taken, ControllerError> {
        let unanswered = self.unanswered(observation, is_first);
        if is_first {
            self.answer = None;
            // Here only where the last episode was cut: else it happened in the idle time after its end.
            self.swap(Moment::BetweenEpisodes);
        }
        self.filter.observed(observation, is_first);
        let rewound = self.rewind(observation.sequence, is_first);
        let (decision, event) = self.decide(observation, is_first);
        let (source, action) = self.respond(event, decision.as_ref())?;
        self.pacing.observed(observation, received_ns);
        let overtaken = self.is_overtaken(observation, received_ns)?;
        let answer = self.send_unless(overtaken, observation.sequence, source, action)?;
        let sent = answer.published_ns > 0;
        self.own_answer = sent.then_some(answer);
        let Stamps { scheduled_ns, published_ns, .. } = Stamps::of(observation, received_ns);
        let times = TickTimes { scheduled_ns, published_ns, received_ns, sent_ns: answer.published_ns };
        self.record_times(observation, &times, unanswered);
        self.count_episode(observation, is_first);
        let observed = Some(observation);
        self.show(
            &Ticked { observation: observed, is_first, rewound, decision, answer, overtaken: !sent, times },
            observers,
        );
        self.finish_episode(observation);
        if sent {
            // Here the idle time begins.
            let is_last = observation.is(ObservationFlags::LAST);
            self.swap(if is_last { Moment::BetweenEpisodes } else { Moment::InEpisode });
            self.work_ahead((!is_last).then_some(&answer.action));
        }
        Ok(Taken::New)
    }

    /// Goes back to before a tick was imagined whose observation came after all.
    fn rewind(&mut self, sequence: u64, is_first: bool) -> bool {
        let rewound = match self.imagined.before(sequence) {
            // A state that the policy has given fits it.
            Some(state) if !is_first => self.policy.set_state(state).is_ok(),
            _ => false,
        };
        self.imagined.clear();
        self.counters.late_observations += u64::from(rewound);
        rewound
    }

    /// The policy's decision, and whether it is fit to be sent.
    fn decide(&mut self, observation: &Observation<'_>, is_first: bool) -> (Option<Decision>, Event) {
        let inputs = self.inputs.read(observation).filter(|_| observation.is_valid());
        let Some(inputs) = inputs else {
            self.counters.refused_observations += 1;
            // What is seen next is the first that the policy sees of this episode.
            self.fresh_policy |= is_first;
            return (None, Event::Invalid(Cause::Observation));
        };
        // A new policy starts where it takes over, as at the first of an episode.
        let is_first = is_first | std::mem::take(&mut self.fresh_policy);
        let executed = observation.executed_action();
        let decided = self.policy.observe(inputs, (!is_first).then_some(&executed));
        let decision = match decided {
            Ok(decision) => decision,
            Err(error) => return (None, Event::Invalid(self.count_failure(&error))),
        };
        self.record_stages(&decision);
        self.counters.recomputed += u64::from(decision.recomputed);
        self.counters.helper_late += u64::from(decision.helper_late);
        // Every scene is new at the first image of an episode.
        let surprise = decision.surprise.filter(|_| !is_first);
        let Some(surprise) = surprise else { return (Some(decision), Event::Decided) };
        self.surprise.record(&surprise);
        let exceeded = self.settings.surprise.exceeded_by(&surprise).map(|branch| match branch {
            PartName::Robot => (Cause::RobotSurprise, &mut self.counters.robot_surprises),
            PartName::Dynamics => (Cause::DynamicsSurprise, &mut self.counters.dynamics_surprises),
            _ => (Cause::EnvironmentSurprise, &mut self.counters.environment_surprises),
        });
        let exceeded = exceeded.map(|(cause, count)| {
            *count += 1;
            cause
        });
        (Some(decision), exceeded.map_or(Event::Decided, Event::Invalid))
    }

    fn count_failure(&mut self, error: &PolicyError) -> Cause {
        match error {
            PolicyError::NotFinite { .. } => {
                self.counters.non_finite_outputs += 1;
                Cause::Output
            }
            _ => {
                self.counters.engine_errors += 1;
                Cause::Engine
            }
        }
    }

    /// What to send after an event.
    fn respond(&mut self, event: Event, decision: Option<&Decision>) -> Result<Chosen, ControllerError> {
        let (state, response) = step(self.state, event, self.settings.ticks);
        self.state = state;
        if let State::Stopped { cause } = state {
            return Err(ControllerError::Stopped { cause, ticks: self.settings.ticks.fallback_ticks_max });
        }
        Ok(match (response, decision) {
            (Response::Policy, Some(decision)) => (ActionSource::Policy, Some(decision.action)),
            (Response::Imagine, Some(decision)) => (ActionSource::Imagined, Some(decision.action)),
            _ => self.fallback(),
        })
    }

    fn fallback(&self) -> Chosen {
        (ActionSource::Fallback, self.filter.fallback(self.settings.fallback))
    }

    /// Answers a tick whose observation has not come.
    pub(super) fn handle_missing(
        &mut self,
        observers: &mut [&mut dyn TickObserver],
    ) -> Result<(), ControllerError> {
        let found_ns = self.link.now_ns();
        let Some(missing) = self.pacing.take_overdue(found_ns) else { return Ok(()) };
        // Where the policy has just taken over, it has seen nothing that it could go on from.
        let held = self.filter.held().filter(|_| !self.fresh_policy);
        let (mut state, mut response) = step(self.state, Event::Overdue, self.settings.ticks);
        if response == Response::Imagine && held.is_none() {
            (state, response) = step(self.state, Event::Invalid(Cause::Silence), self.settings.ticks);
        }
        self.state = state;
        let (decision, (source, action)) = match (response, held) {
            (Response::Imagine, Some(held)) => self.imagine(missing.sequence, &held)?,
            (Response::Imagine | Response::Fallback, _) => (None, self.fallback()),
            (Response::Policy | Response::Nothing, _) => {
                self.counters.peers_lost += 1;
                self.pacing.rest();
                return Ok(());
            }
        };
        // What has come by now is worth more than an answer without it, if it will be answered itself.
        self.take_newer()?;
        let overtaken = self.newer.as_ref().is_some_and(|newer| self.will_answer(newer));
        let answer = self.send_unless(overtaken, missing.sequence, source, action)?;
        let times = TickTimes {
            scheduled_ns: missing.scheduled_ns,
            published_ns: 0,
            received_ns: found_ns,
            sent_ns: answer.published_ns,
        };
        self.record_missing(&missing, &times);
        self.show(
            &Ticked {
                observation: None,
                is_first: false,
                rewound: false,
                decision,
                answer,
                overtaken: answer.published_ns == 0,
                times,
            },
            observers,
        );
        if answer.published_ns > 0 {
            self.work_ahead(Some(&answer.action));
        }
        Ok(())
    }

    /// The policy on an imagined frame; the fallback where that fails. What a policy without a world model holds is no imagination, and
    /// marked as the fallback that it is.
    fn imagine(
        &mut self,
        sequence: u64,
        held: &ActionValues,
    ) -> Result<(Option<Decision>, Chosen), ControllerError> {
        self.imagined.note(sequence, self.policy.state());
        match self.policy.imagine(held) {
            Ok(decision) => {
                let imagined = self.policy.imagines();
                let source = if imagined { ActionSource::Imagined } else { ActionSource::Fallback };
                Ok((Some(decision), (source, Some(decision.action))))
            }
            Err(error) => {
                self.imagined.take_back();
                let cause = self.count_failure(&error);
                Ok((None, self.respond(Event::Invalid(cause), None)?))
            }
        }
    }

    /// In the idle time: all of the next tick that needs only the action. What fails here fails again, and is counted, in the tick.
    fn work_ahead(&mut self, action: Option<&ActionValues>) {
        let start_ns = self.link.now_ns();
        // See above: the tick tells.
        let _ = self.policy.work_ahead(action.filter(|_| !self.fresh_policy));
        self.telemetry.record(Stage::Ahead, self.link.now_ns() - start_ns);
    }

    fn show(&self, ticked: &Ticked<'_>, observers: &mut [&mut dyn TickObserver]) {
        let Some(running) = self.running else { return };
        let Ticked { observation, is_first, rewound, decision, answer, overtaken, times } = *ticked;
        let Self { policy, telemetry, counters, episodes, state, .. } = self;
        let tick = Tick {
            observation,
            is_first,
            rewound,
            decision,
            answer,
            overtaken,
            state: *state,
            times,
            policy,
            telemetry,
            counters,
            episodes,
            running,
        };
        for observer in observers {
            observer.ticked(&tick);
        }
    }

    fn count_episode(&mut self, observation: &Observation<'_>, is_first: bool) {
        if is_first {
            self.cut_episode();
        }
        self.running.get_or_insert_with(|| EpisodeResult::start(observation)).add(observation);
    }

    fn finish_episode(&mut self, observation: &Observation<'_>) {
        if observation.is(ObservationFlags::LAST)
            && let Some(mut episode) = self.running.take()
        {
            episode.whole = episode.from_first;
            self.whole_episodes += u64::from(episode.whole);
            self.episodes.push(episode);
        }
    }

    /// Puts aside an episode whose last observation will not come.
    pub(super) fn cut_episode(&mut self) {
        self.running.take().into_iter().for_each(|running| self.episodes.push(running));
    }
}
