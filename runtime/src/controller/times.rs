//! The times of a tick, counted from when it was scheduled: one that is late or never answered cannot hide.

use rcwm_models::wire::{ObservationFlags, ObservationHeader};

use super::{Controller, Pace, TickTimes};
use crate::pacing::Missing;
use crate::policy::Decision;
use crate::telemetry::Stage;

/// Ticks without an answer that are told one by one in the latency from the schedule.
const UNANSWERED_TOLD_MAX: u64 = 1000;

impl Controller {
    /// Ticks before this one, of this publisher, that were not answered in any way (real time).
    pub(super) fn unanswered(&self, observation: &ObservationHeader, is_first: bool) -> u64 {
        match self.answer {
            Some(answer) if !is_first && observation.period_ns > 0 => {
                observation.sequence.saturating_sub(answer.answers.saturating_add(1))
            }
            _ => 0,
        }
    }

    pub(super) fn record_stages(&mut self, decision: &Decision) {
        self.telemetry.record_policy(&decision.stage_ns);
    }

    pub(super) fn record_times(
        &mut self,
        observation: &ObservationHeader,
        times: &TickTimes,
        unanswered: u64,
    ) {
        let TickTimes { scheduled_ns, published_ns, received_ns, .. } = *times;
        let period_ns = observation.period_ns;
        self.pace = Some(Pace::of(period_ns));
        // An answer that was overtaken is late by all the time until now.
        let ended_ns = if times.sent_ns == 0 { self.link.now_ns() } else { times.sent_ns };
        let telemetry = &mut self.telemetry;
        telemetry.record(Stage::Receive, received_ns.saturating_sub(published_ns));
        telemetry.record(Stage::Tick, ended_ns.saturating_sub(received_ns));
        telemetry.record(Stage::EndToEnd, ended_ns.saturating_sub(published_ns));
        // One that was sent again for us is older than we are.
        if period_ns == 0 || observation.is(ObservationFlags::REPEATED) {
            return;
        }
        telemetry.record(Stage::PublishLag, published_ns.saturating_sub(scheduled_ns));
        let from_schedule_ns = ended_ns.saturating_sub(scheduled_ns);
        for ticks in 0..=unanswered.min(UNANSWERED_TOLD_MAX) {
            let waited_ns = from_schedule_ns.saturating_add(period_ns.saturating_mul(ticks));
            telemetry.record(Stage::FromSchedule, waited_ns);
        }
        let counters = &mut self.counters;
        counters.published_late += u64::from(published_ns > scheduled_ns.saturating_add(period_ns));
        let missed = times.sent_ns == 0 || from_schedule_ns > period_ns;
        let ours_in_time = times.sent_ns > 0 && ended_ns.saturating_sub(published_ns) <= period_ns;
        // What a peer says may be any number.
        counters.missed_deadlines =
            counters.missed_deadlines.saturating_add(unanswered).saturating_add(u64::from(missed));
        counters.missed_deadlines_published_late += u64::from(missed && ours_in_time);
    }

    pub(super) fn record_missing(&mut self, missing: &Missing, times: &TickTimes) {
        self.counters.skipped_ticks = self.counters.skipped_ticks.saturating_add(missing.skipped);
        // Where it was not sent, the observation that came instead tells.
        if times.sent_ns > 0 {
            self.telemetry.record(Stage::Imagine, times.sent_ns.saturating_sub(times.received_ns));
            self.telemetry.record(Stage::FromSchedule, times.sent_ns.saturating_sub(times.scheduled_ns));
        }
    }
}
