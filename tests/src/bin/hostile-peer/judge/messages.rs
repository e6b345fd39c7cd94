//! What the controller takes from the link.

use rcwm_models::ACTION_LEN;
use rcwm_models::wire::ObservationFlags;

use super::due::Due;
use super::{Heard, Judge, Newest};

impl Judge {
    /// The controller took a message from the link; `polled` where it did not wait for it.
    pub(crate) fn received(&mut self, heard: Heard, polled: bool) {
        self.received += 1;
        self.unsent += u64::from(polled);
        self.turned_stale(heard.received_ns);
        if heard.is_stale_at(heard.received_ns, self.setup.pacing.stale_periods) {
            return;
        }
        let mut borderline = false;
        let begins = match &self.newest {
            Some(newest) if newest.heard.publisher == heard.publisher => {
                if heard.sequence == newest.heard.sequence {
                    self.received_again(&heard);
                    return;
                }
                let is_old = heard.sequence < newest.heard.sequence;
                if is_old && !self.may_follow_previous(newest, &heard) {
                    return;
                }
                borderline = is_old;
                heard.flags.contains(ObservationFlags::FIRST) || newest.heard.episode != heard.episode
            }
            _ => true,
        };
        if let Some(mut newest) = self.newest {
            if !newest.may_be_dropped() {
                self.previous.clear();
            }
            if newest.answer.is_none() {
                // What was found meanwhile may turn stale, and this one be the newest without an answer.
                newest.overtaken = polled;
                newest.borderline |= polled;
                self.unanswered_executed
                    .extend(Some(newest.heard.executed).filter(|_| newest.heard.is_fit()));
            }
            self.previous.push((newest, self.in_episode));
        }
        if begins {
            self.in_episode = false;
        }
        self.begins_anew();
        if polled && self.newest.is_some_and(|newest| newest.answer.is_none() && newest.heard.is_fit()) {
            // The policy has decided on the one before, and was overtaken: it was fit, as far as that is known here.
            self.may_have_begun_anew();
        }
        let says_nothing =
            heard.flags.contains(ObservationFlags::FIRST) && heard.executed == [0.0; ACTION_LEN];
        self.is_held |= heard.is_executable() && !says_nothing;
        self.due = Due::default();
        let follows = heard.period_ns > 0 && !heard.flags.contains(ObservationFlags::LAST);
        self.newest = Some(Newest {
            heard,
            answer: None,
            stand_ins: 0,
            borderline,
            swapped: false,
            follows,
            unclear: false,
            overtaken: false,
            stood_in_for: false,
            executed_again: None,
            exhausted: false,
        });
    }

    /// Whether a message that is older than the newest is newer than one before, in case all since were dropped.
    fn may_follow_previous(&self, newest: &Newest, heard: &Heard) -> bool {
        let follows =
            |previous: &Heard| previous.publisher != heard.publisher || previous.sequence < heard.sequence;
        let mut before = self.previous.iter();
        newest.may_be_dropped()
            && (self.previous.is_empty() || before.any(|(previous, _)| follows(&previous.heard)))
    }

    /// A message that is not old ends a silence.
    fn begins_anew(&mut self) {
        let used_up = self.fallbacks + self.unsent >= u64::from(self.setup.ticks.fallback_ticks_max);
        if std::mem::take(&mut self.silent) {
            (self.imagined, self.fallbacks, self.unsent) = (0, 0, 0);
        } else if used_up
            && (self.unsent > 0
                || self.newest.is_some_and(|newest| newest.unclear || newest.may_be_dropped()))
        {
            // Where it is not known what was due or counted, neither is whether it has fallen silent.
            self.may_have_begun_anew();
        }
    }

    /// It counts from none, or goes on from what was sent.
    fn may_have_begun_anew(&mut self) {
        self.unsent += self.imagined + self.fallbacks;
        (self.imagined, self.fallbacks) = (0, 0);
    }

    fn received_again(&mut self, heard: &Heard) {
        self.begins_anew();
        let Some(newest) = &mut self.newest else { return };
        // Which of two schedules counts depends on what was imagined meanwhile.
        let same = |a: &Heard, b: &Heard| {
            (a.period_ns, a.scheduled_ns, a.published_ns, a.flags)
                == (b.period_ns, b.scheduled_ns, b.published_ns, b.flags)
        };
        if !same(&newest.heard, heard) {
            (newest.follows, newest.unclear) = (false, true);
        }
        if newest.answer.is_none() {
            newest.borderline = true;
        }
        newest.executed_again = Some(heard.executed).filter(|_| heard.is_executable());
        self.due = Due::default();
    }

    /// A message may turn stale between link and loop; nothing is asked of it then.
    pub(super) fn turned_stale(&mut self, now_ns: u64) {
        let stale = self.setup.pacing.stale_periods;
        if let Some(newest) = &mut self.newest
            && newest.answer.is_none()
            && newest.heard.may_be_stale_at(now_ns, stale)
        {
            newest.borderline = true;
        }
    }

    /// The peer's closing reached the controller, which begins anew with the next message.
    pub(crate) fn closed(&mut self) {
        self.silent = true;
        if let Some(newest) = &mut self.newest {
            newest.follows = false;
        }
        self.due = Due::default();
    }
}
