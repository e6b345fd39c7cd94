//! The way onto the wire: nothing that a newer observation has overtaken, nothing that has not passed the safety filter.

use rcwm_models::wire::{
    Action, ActionSource, ActionValues, Observation, ObservationFlags, ObservationSample,
};

use super::{Arrival, Controller, ControllerError};
use crate::pacing::Stamps;

/// An answer that stays here.
fn unsent(sequence: u64, source: ActionSource, action: Option<ActionValues>) -> Action {
    let action = action.unwrap_or_default();
    Action { answers: sequence, published_ns: 0, source: source as u32, action }
}

impl Controller {
    /// Whether a newer observation has come while this one was worked on: an answer to this one would be stale. Looked for only
    /// where the tick's time is over, so that a tick in time loses none.
    pub(super) fn is_overtaken(
        &mut self,
        observation: &Observation<'_>,
        received_ns: u64,
    ) -> Result<bool, ControllerError> {
        let (period_ns, due_ns) = (observation.period_ns, Stamps::of(observation, received_ns).scheduled_ns);
        if period_ns == 0 || self.link.now_ns() <= due_ns.saturating_add(period_ns) {
            return Ok(false);
        }
        self.take_newer()?;
        Ok(self.newer.as_ref().is_some_and(|newer| self.arrival(newer, self.link.now_ns()).is_new()))
    }

    /// What an observation is to those before it; one that was due too long ago is stale, whatever its number.
    pub(super) fn arrival(&self, sample: &ObservationSample, received_ns: u64) -> Arrival {
        if self.pacing.is_stale(sample, received_ns) {
            return Arrival::Stale;
        }
        self.tracker.look(sample.origin(), sample.sequence, sample.episode)
    }

    /// Whether an observation that has come will get an answer of its own, however many ticks were answered without it.
    pub(super) fn will_answer(&self, sample: &ObservationSample) -> bool {
        let arrival = self.arrival(sample, self.link.now_ns());
        let again = || {
            let known = self.own_answer.is_some_and(|own| own.answers == sample.sequence);
            known && sample.is(ObservationFlags::REPEATED)
        };
        arrival.is_new() || (arrival == Arrival::Repeated && again())
    }

    /// Sends, or counts that a newer observation has made the answer stale.
    pub(super) fn send_unless(
        &mut self,
        overtaken: bool,
        sequence: u64,
        source: ActionSource,
        action: Option<ActionValues>,
    ) -> Result<Action, ControllerError> {
        if !overtaken {
            return self.send(sequence, source, action);
        }
        self.counters.overtaken_answers += 1;
        Ok(unsent(sequence, source, action))
    }

    /// The only way onto the wire. Where there is nothing valid to send nor to hold, the robot goes on with what it knows itself.
    pub(super) fn send(
        &mut self,
        sequence: u64,
        source: ActionSource,
        action: Option<ActionValues>,
    ) -> Result<Action, ControllerError> {
        let Some(passed) = action.and_then(|action| self.filter.pass(action)) else {
            self.counters.withheld_answers += 1;
            return Ok(unsent(sequence, ActionSource::Fallback, None));
        };
        self.counters.non_finite_outputs += u64::from(passed.was_not_finite);
        self.counters.rate_limited += u64::from(passed.rate_limited);
        let source = if passed.was_not_finite { ActionSource::Fallback } else { source };
        let mut answer =
            Action { answers: sequence, published_ns: 0, source: source as u32, action: passed.action };
        answer.published_ns = self.link.send(&answer)?;
        self.filter.sent(answer.action);
        self.answer = Some(answer);
        self.counters.answers += 1;
        self.counters.fallback_answers += u64::from(source == ActionSource::Fallback);
        self.counters.imagined_answers += u64::from(source == ActionSource::Imagined);
        Ok(answer)
    }
}
