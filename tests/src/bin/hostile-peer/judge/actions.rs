//! What each action on the wire answers.

use std::hash::Hash;

use rcwm_models::wire::{Action, ActionSource, ObservationFlags};

use super::due::Due;
use super::{Heard, Judge, Newest};
use crate::bundles::Known;

impl Judge {
    /// An action is on the wire. `waiting` is the message in the link that the controller has not taken.
    pub(crate) fn sent(&mut self, action: &Action, waiting: Option<&Heard>, now_ns: u64) {
        self.sent.all += 1;
        (action.answers, action.source, action.action.to_bits()).hash(&mut self.digest);
        let Some(source) = ActionSource::from_wire(action.source) else {
            return self.object("marked", || format!("an unknown source: {action:?}"));
        };
        self.sent.by_source[source as usize] += 1;
        if action.action.iter().any(|x| !x.is_finite()) {
            self.object("not finite", || format!("{action:?}"));
        }
        let within = |running: &Known| running.limits.clamp(action.action) == action.action;
        if !self.running.iter().any(within) {
            let running = self.running.clone();
            self.object("out of limits", || format!("{action:?}, running {running:?}"));
        }
        let Some(newest) = self.newest else {
            return self.object("answers nothing", || format!("{action:?} before any message"));
        };
        self.turned_stale(self.looks_ns[1]);
        let newest = self.newest_for(action, source, now_ns).unwrap_or(newest);
        self.bases = self.bases_of(&newest);
        self.before = self.last.filter(|_| self.in_episode);
        self.is_free = self.may_withhold();
        self.check_rate(action);
        self.check_target(action, source);
        if action.answers == newest.heard.sequence {
            self.answered(action, source, newest, waiting);
        } else if action.answers > newest.heard.sequence {
            self.stood_in(action, source, newest, now_ns);
        } else {
            self.object("stale", || format!("{action:?}, but {:?} is newer", newest.heard));
        }
        self.last = Some(*action);
        (self.in_episode, self.is_held) = (true, true);
        self.unanswered_executed.clear();
        self.due = Due::default();
    }

    /// The newest message when this was sent: one before where those since may have turned stale on the way, and this is for none of
    /// them, nor for what is missing after one of them that was overtaken.
    fn newest_for(&mut self, action: &Action, source: ActionSource, now_ns: u64) -> Option<Newest> {
        let grace = self.setup.pacing.grace_periods;
        let may_follow = |Newest { heard, overtaken, follows, .. }: &Newest| {
            let ticks = action.answers.saturating_sub(heard.sequence);
            *overtaken && *follows && ticks > 0 && now_ns >= heard.due_ns(ticks, grace).0
        };
        let is_for =
            |newest: &Newest| action.answers == newest.heard.sequence && source != ActionSource::Imagined;
        while let Some(newest) = self.newest
            && newest.may_be_dropped()
            && !is_for(&newest)
            && !may_follow(&newest)
            && let Some((previous, in_episode)) = self.previous.pop()
        {
            (self.newest, self.in_episode) = (Some(previous), in_episode);
        }
        self.newest
    }

    /// An answer to the newest message.
    fn answered(
        &mut self,
        action: &Action,
        source: ActionSource,
        mut newest: Newest,
        waiting: Option<&Heard>,
    ) {
        // It was taken at the look before the last, or earlier: the last asks whether its time is over.
        let [taken_ns, seen_ns] = self.looks_ns;
        if newest.answer.is_none() {
            newest.heard.taken_ns = taken_ns.max(newest.heard.received_ns);
        }
        let heard = newest.heard;
        if let Some(first) = newest.answer {
            self.sent.repeated += 1;
            if source == ActionSource::Policy {
                self.count(source);
            }
            let may_change = newest.swapped || newest.stand_ins > 0;
            let same = first.source == action.source
                && (first.action == action.action || may_change && self.is_made_of(action, &first.action));
            if newest.stood_in_for {
                self.unsent += 1;
            } else if !same {
                self.object("another answer", || format!("{action:?} after {first:?} to the same message"));
            }
            if newest.stand_ins > 0 {
                newest.stand_ins = 0;
                (newest.follows, newest.exhausted) = (false, false);
            }
            // Where it has changed, it is this one that is given from here on.
            (newest.answer, newest.swapped) = (Some(*action), self.running.len() > 1);
            newest.stood_in_for &= source == ActionSource::Fallback;
            self.newest = Some(newest);
            return;
        }
        let over_ns = heard.scheduled_ns.min(heard.taken_ns).saturating_add(heard.period_ns);
        // It looks once, when the time is over; what comes later cannot be known.
        let came_later =
            |other: &Heard| self.polled_ns > over_ns.max(taken_ns) && other.received_ns > self.polled_ns;
        if let Some(other) = waiting
            && heard.period_ns > 0
            && seen_ns > over_ns
            && !came_later(other)
            && (other.publisher != heard.publisher || other.sequence > heard.sequence)
            && !other.is_stale_at(seen_ns, self.setup.pacing.stale_periods)
        {
            self.object("overtaken", || format!("{action:?} answers {heard:?}, while {other:?} waits"));
        }
        let surprise = &self.setup.surprise;
        let invalid = !heard.is_fit();
        let is_sound = self.running.iter().all(|running| running.is_sound);
        let may_fail = !is_sound || surprise.robot_max.is_some() || surprise.environment_max.is_some();
        let marked = match source {
            ActionSource::Policy => !invalid,
            // One that had turned stale may be stood in for.
            ActionSource::Fallback => invalid || may_fail || newest.borderline,
            ActionSource::Imagined => false,
        };
        if !marked {
            self.object("marked", || format!("{action:?} answers {heard:?}"));
        }
        self.count(source);
        (newest.answer, newest.swapped) = (Some(*action), self.running.len() > 1);
        if newest.borderline && source == ActionSource::Fallback {
            // Its own answer, or the stand-in for it where it had turned stale: then what is due is the one before's.
            (newest.follows, newest.unclear, newest.stood_in_for) = (false, true, true);
        }
        self.newest = Some(newest);
    }

    /// A stand-in for a message that has not come.
    fn stood_in(&mut self, action: &Action, source: ActionSource, mut newest: Newest, now_ns: u64) {
        let heard = newest.heard;
        let ticks = action.answers - heard.sequence;
        let last = heard.period_ns == 0 || heard.flags.contains(ObservationFlags::LAST);
        if last && !newest.unclear {
            self.object("stand-in", || format!("{action:?}, but nothing is due after {heard:?}"));
        }
        if newest.answer.is_none() && !newest.borderline {
            self.object("stand-in", || format!("{action:?}, but {heard:?} waits for its answer"));
        }
        if newest.follows && now_ns < heard.due_ns(ticks, self.setup.pacing.grace_periods).0 {
            self.object("stand-in", || format!("{action:?} at {now_ns} is too early after {heard:?}"));
        }
        if newest.exhausted {
            self.object("too many", || format!("{action:?} after as many as are allowed after {heard:?}"));
        }
        if ticks <= newest.stand_ins {
            self.object("stand-in", || format!("{action:?} comes again"));
        }
        if source == ActionSource::Policy {
            self.object("marked", || format!("{action:?} answers nothing, newest {heard:?}"));
        }
        newest.stand_ins = ticks;
        self.newest = Some(newest);
        self.count(source);
    }

    fn count(&mut self, source: ActionSource) {
        match source {
            ActionSource::Policy => (self.imagined, self.fallbacks, self.unsent) = (0, 0, 0),
            ActionSource::Imagined if self.fallbacks > 0 => {
                self.object("marked", || "imagined after a fallback, without an observation".into());
            }
            ActionSource::Imagined => self.imagined += 1,
            ActionSource::Fallback => self.fallbacks += 1,
        }
        let ticks = self.setup.ticks;
        if self.imagined > u64::from(ticks.imagined_ticks_max) {
            self.object("too many", || format!("imagined in a row, limit {}", ticks.imagined_ticks_max));
        }
        if self.fallbacks > u64::from(ticks.fallback_ticks_max) {
            self.object("too many", || format!("fallbacks in a row, limit {}", ticks.fallback_ticks_max));
        }
    }
}
