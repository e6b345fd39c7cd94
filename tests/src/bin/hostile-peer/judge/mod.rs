//! What every action on the wire must be, told from what went over the wire alone.
//!
//! The judge sees each message as the controller takes it from the link, each action as the peer receives it, and each look of the
//! controller at its clock. It knows the contract (`docs/controller.md`), not the code.

mod heard;
#[cfg(test)]
mod tests;

use std::hash::{DefaultHasher, Hash, Hasher};

use rcwm_models::ACTION_LEN;
use rcwm_models::wire::{Action, ActionSource, ObservationFlags};
use rcwm_runtime::controller::{Counters, Fallback};
use rcwm_runtime::policy::ActionLimits;

pub(crate) use heard::Heard;

use crate::bundles::Known;
use crate::scenario::Setup;

type Vector = [f32; ACTION_LEN];

/// The controller looks at the link so often, at most, before it sends a stand-in that is due.
const LOOKS_MAX: u32 = 3;

/// Something that must not happen.
#[derive(Debug, Clone)]
pub(crate) struct Violation {
    /// Which invariant.
    pub(crate) kind: &'static str,
    /// What is known about it.
    pub(crate) text: String,
}

/// The newest message that was worth an answer, and what became of it.
#[derive(Debug, Clone, Copy)]
struct Newest {
    heard: Heard,
    /// Its answer, as it was sent last.
    answer: Option<Action>,
    /// Stand-ins since.
    stand_ins: u64,
    /// It may have turned stale between link and loop.
    borderline: bool,
    /// The limits have changed since its answer.
    swapped: bool,
    /// The next one is due by its clock; else nothing is.
    follows: bool,
    /// It came again and said something else, so that it is not known what is due.
    unclear: bool,
    /// What was executed, as it said when it came again.
    executed_again: Option<Vector>,
    /// No stand-in may come any more.
    exhausted: bool,
}

impl Newest {
    /// It has no answer and may need none.
    fn may_be_dropped(&self) -> bool {
        self.borderline && self.answer.is_none()
    }
}

/// A stand-in that is due.
#[derive(Debug, Clone, Copy, Default)]
struct Due {
    is_due: bool,
    looks: u32,
}

/// What has been sent, by source.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Sent {
    pub(crate) all: u64,
    pub(crate) by_source: [u64; 3],
    pub(crate) repeated: u64,
}

pub(crate) struct Judge {
    setup: Setup,
    /// The running bundle; two where a swap may or may not have happened.
    running: Vec<Known>,
    newest: Option<Newest>,
    /// Those before, and whether their episodes had begun. The first was not dropped for certain; all others may have turned stale on
    /// the way, and so may the newest, so that each of them may still be the newest to the controller.
    previous: Vec<(Newest, bool)>,
    last: Option<Action>,
    /// `last` belongs to the running episode.
    in_episode: bool,
    /// Something was sent, or is said to have been executed, that can be held.
    is_held: bool,
    /// Stand-ins and fallbacks since the policy's last answer.
    imagined: u64,
    fallbacks: u64,
    /// Messages since then that were found in the middle of a tick: as many ticks may have been counted and not sent.
    unsent: u64,
    /// The controller may have fallen silent since, and begins anew with the next message.
    silent: bool,
    due: Due,
    /// The controller's last two looks at its clock.
    looks_ns: [u64; 2],
    /// The controller's last look at the link, other than to wait.
    polled_ns: u64,
    /// No rate limit can hold for the last action: it was the first position, and where the robot stood was not known.
    is_free: bool,
    /// Where the last action may have started from, for the check of what the policy decided.
    bases: Vec<Vector>,
    /// The action before the last, of the same episode.
    before: Option<Action>,
    received: u64,
    pub(crate) sent: Sent,
    digest: DefaultHasher,
    pub(crate) violation: Option<Violation>,
    /// Kinds that are not told.
    ignored: Vec<String>,
}

impl Judge {
    pub(crate) fn new(setup: Setup, running: Known, ignored: Vec<String>) -> Self {
        Self {
            setup,
            running: vec![running],
            newest: None,
            previous: Vec::new(),
            last: None,
            in_episode: false,
            is_held: false,
            imagined: 0,
            fallbacks: 0,
            unsent: 0,
            silent: false,
            due: Due::default(),
            looks_ns: [0; 2],
            polled_ns: 0,
            is_free: false,
            bases: Vec::new(),
            before: None,
            received: 0,
            sent: Sent::default(),
            digest: DefaultHasher::new(),
            violation: None,
            ignored,
        }
    }

    pub(crate) fn object(&mut self, kind: &'static str, text: impl FnOnce() -> String) {
        if self.violation.is_none() && !self.ignored.iter().any(|ignored| ignored == kind) {
            self.violation = Some(Violation { kind, text: text() });
        }
    }

    /// This bundle runs from now on.
    pub(crate) fn runs_with(&mut self, running: Known) {
        self.running.clear();
        self.may_run_with(running);
    }

    /// This bundle may run from now on.
    pub(crate) fn may_run_with(&mut self, running: Known) {
        self.running.push(running);
        if let Some(newest) = &mut self.newest {
            newest.swapped = true;
        }
    }

    /// Zeros may be a pose, for which something must be known that can be held.
    fn may_withhold(&self) -> bool {
        !self.is_held && self.running.iter().any(|running| running.is_absolute)
    }

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
        if let Some(newest) = self.newest {
            if !newest.may_be_dropped() {
                self.previous.clear();
            }
            self.previous.push((newest, self.in_episode));
        }
        if begins {
            self.in_episode = false;
        }
        self.begins_anew();
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
        } else if used_up && self.newest.is_some_and(|newest| newest.unclear || newest.may_be_dropped()) {
            // Where it is not known what was due, neither is whether it has fallen silent.
            self.unsent += self.imagined + self.fallbacks;
            (self.imagined, self.fallbacks) = (0, 0);
        }
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
    fn turned_stale(&mut self, now_ns: u64) {
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

    /// The controller looked at its clock.
    pub(crate) fn looked(&mut self, now_ns: u64) {
        self.looks_ns = [self.looks_ns[1], now_ns];
        let Some(newest) = self.newest.filter(|newest| newest.follows && newest.answer.is_some()) else {
            return;
        };
        // Nothing can be named that comes after the last sequence.
        let ticks = newest.stand_ins + 1;
        if newest.heard.sequence.checked_add(ticks).is_none()
            || now_ns < newest.heard.due_ns(ticks, self.setup.pacing.grace_periods).1
        {
            return;
        }
        let (imagined_max, fallbacks_max) =
            (self.setup.ticks.imagined_ticks_max, self.setup.ticks.fallback_ticks_max);
        let left = self.imagined + self.unsent < u64::from(imagined_max) && self.fallbacks == 0
            || self.fallbacks + self.unsent < u64::from(fallbacks_max);
        self.due.is_due |= left && !self.may_withhold();
        if !left {
            // It has fallen silent, for certain where all of them were sent.
            self.silent = true;
            if let Some(newest) = &mut self.newest {
                newest.exhausted = self.fallbacks >= u64::from(fallbacks_max);
            }
        }
    }

    /// The controller looks whether a message has come; `waits` where it lets time pass.
    pub(crate) fn looks_at_link(&mut self, now_ns: u64, waits: bool) {
        self.turned_stale(now_ns);
        if self.due.is_due {
            self.due.looks += 1;
            if self.due.looks > LOOKS_MAX {
                let newest = self.newest.map(|newest| newest.heard);
                self.object("no stand-in", || {
                    format!("one has been due since {LOOKS_MAX} looks at the link; now {now_ns}, newest {newest:?}")
                });
            }
        }
        if !waits {
            self.polled_ns = now_ns;
            return;
        }
        if let Some(newest) = self.newest
            && newest.answer.is_none()
            && !newest.borderline
            && !self.may_withhold()
        {
            self.object("not answered", || format!("waits at {now_ns} for more after {:?}", newest.heard));
        }
    }

    /// An action is on the wire. `waiting` is the message in the link that the controller has not taken.
    pub(crate) fn sent(&mut self, action: &Action, waiting: Option<&Heard>, now_ns: u64) {
        self.sent.all += 1;
        (action.answers, action.source, action.action.map(f32::to_bits)).hash(&mut self.digest);
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
        let newest = self.newest_for(action, source).unwrap_or(newest);
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
        self.due = Due::default();
    }

    /// The newest message when this was sent: one before where those since may have turned stale on the way, and this is for none of
    /// them.
    fn newest_for(&mut self, action: &Action, source: ActionSource) -> Option<Newest> {
        let is_for = |newest: &Newest| {
            action.answers == newest.heard.sequence && source != ActionSource::Imagined
        };
        while let Some(newest) = self.newest
            && newest.may_be_dropped()
            && !is_for(&newest)
            && let Some((previous, in_episode)) = self.previous.pop()
        {
            (self.newest, self.in_episode) = (Some(previous), in_episode);
        }
        self.newest
    }

    /// What the robot may have executed last: the rate limit counts from one of them, and holding means one of them.
    fn bases_of(&self, newest: &Newest) -> Vec<Vector> {
        let mut bases: Vec<Vector> = self.last.iter().map(|last| last.action).collect();
        let starts = !self.in_episode;
        // What the peer says was executed counts as long as no stand-in was sent since.
        if newest.stand_ins == 0 && newest.heard.is_executable() {
            bases.push(newest.heard.executed);
        }
        bases.extend(newest.executed_again);
        let rests = self.running.iter().any(|running| !running.is_absolute);
        if rests && starts && (newest.heard.flags.contains(ObservationFlags::FIRST) || bases.is_empty()) {
            bases.push([0.0; ACTION_LEN]);
        }
        bases
    }

    fn check_rate(&mut self, action: &Action) {
        let Some(rate_max) = self.setup.rate_max.filter(|_| !self.is_free) else { return };
        let near = |base: &Vector, limits: &ActionLimits| {
            let base = base.map(f64::from);
            (0..ACTION_LEN).all(|i| {
                let (low, high) = (f64::from(limits.low[i]), f64::from(limits.high[i]));
                let slack = 1e-6 * (1.0 + base[i].abs());
                // Limits come last, so that one that lies beyond the rate's reach is gone to at once.
                let lowest = (base[i] - f64::from(rate_max)).clamp(low, high) - slack;
                let highest = (base[i] + f64::from(rate_max)).clamp(low, high) + slack;
                (lowest..=highest).contains(&f64::from(action.action[i]))
            })
        };
        if !self.bases.iter().any(|base| self.running.iter().any(|running| near(base, &running.limits))) {
            let (bases, newest) = (self.bases.clone(), self.newest.map(|newest| newest.heard));
            self.object("rate", || {
                format!("{action:?} after one of {bases:?}, limit {rate_max}; {newest:?}")
            });
        }
    }

    /// Whether an action is what the filter makes of a target, from any base.
    fn is_made_of(&self, action: &Action, target: &Vector) -> bool {
        let made = |limits: &ActionLimits, base: &Vector, i: usize| {
            let wanted = target[i].clamp(limits.low[i], limits.high[i]);
            let Some(rate_max) = self.setup.rate_max.filter(|_| !self.is_free) else { return wanted };
            let near = |base: f32| (base - rate_max, base + rate_max);
            let (mut low, mut high) = near(base[i]);
            // Near to what was sent last, too, where that is possible.
            let last = near(self.before.map_or(base[i], |before| before.action[i]));
            if low.max(last.0) <= high.min(last.1) {
                (low, high) = (low.max(last.0), high.min(last.1));
            }
            wanted.clamp(low, high).clamp(limits.low[i], limits.high[i])
        };
        let near = |a: f32, b: f32| (a - b).abs() <= 1e-6 * (1.0 + b.abs());
        let same = |limits: &ActionLimits, base: &Vector| {
            (0..ACTION_LEN).all(|i| near(made(limits, base, i), action.action[i]))
        };
        let any = |running: &Known| self.bases.iter().any(|base| same(&running.limits, base));
        self.running.iter().any(any)
    }

    /// A fallback is the one that was asked for.
    fn check_target(&mut self, action: &Action, source: ActionSource) {
        if source != ActionSource::Fallback || self.repeats(action) {
            return;
        }
        let holds = || self.bases.iter().any(|base| self.is_made_of(action, base));
        let fits = match self.setup.fallback {
            Fallback::Hold => holds(),
            // Zeros are no rest where actions are positions.
            Fallback::Zero => {
                let any = |absolute: bool| self.running.iter().any(|running| running.is_absolute == absolute);
                any(true) && holds() || any(false) && self.is_made_of(action, &[0.0; ACTION_LEN])
            }
            Fallback::Given(target) => self.is_made_of(action, &target),
        };
        if !fits {
            let (fallback, bases) = (self.setup.fallback, self.bases.clone());
            let newest = self.newest.map(|newest| newest.heard);
            self.object("fallback", || {
                format!("{action:?} is not {fallback:?} after one of {bases:?}; {newest:?}")
            });
        }
    }

    fn repeats(&self, action: &Action) -> bool {
        self.newest.is_some_and(|newest| newest.heard.sequence == action.answers && newest.answer.is_some())
    }

    /// The policy's decision of the tick whose action was just sent.
    pub(crate) fn decided(&mut self, action: &Action, decision: Option<Vector>) {
        if action.source == ActionSource::Fallback as u32 {
            return;
        }
        match decision {
            Some(decision) if self.is_made_of(action, &decision) => {}
            other => {
                let bases = self.bases.clone();
                self.object("marked", || {
                    format!("{action:?}, but the policy decided {other:?} after {bases:?}")
                });
            }
        }
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
            let same = first.source == action.source
                && (first.action == action.action || newest.swapped || newest.stand_ins > 0);
            if !same {
                self.object("another answer", || format!("{action:?} after {first:?} to the same message"));
            }
            if newest.stand_ins > 0 {
                newest.stand_ins = 0;
                (newest.follows, newest.exhausted) = (false, false);
            }
            // Where it has changed, it is this one that is given from here on.
            (newest.answer, newest.swapped) = (Some(*action), self.running.len() > 1);
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
        let unfit = !heard.is_finite || !heard.is_executable();
        let is_sound = self.running.iter().all(|running| running.is_sound);
        let may_fail = !is_sound || surprise.robot_max.is_some() || surprise.environment_max.is_some();
        let marked = match source {
            ActionSource::Policy => !unfit,
            // One that had turned stale may be stood in for.
            ActionSource::Fallback => unfit || may_fail || newest.borderline,
            ActionSource::Imagined => false,
        };
        if !marked {
            self.object("marked", || format!("{action:?} answers {heard:?}"));
        }
        self.count(source);
        newest.answer = Some(*action);
        newest.swapped = false;
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

    /// The controller's own counts against the wire's.
    pub(crate) fn check_counters(&mut self, counters: &Counters, swaps: u64) {
        let Sent { all, by_source, .. } = self.sent;
        let pairs = [
            ("answers", counters.answers, all),
            ("imagined_answers", counters.imagined_answers, by_source[1]),
            ("fallback_answers", counters.fallback_answers, by_source[2]),
            ("swaps", counters.swaps, swaps),
        ];
        for (name, counted, seen) in pairs {
            if counted != seen {
                self.object("counters", || format!("{name} is {counted}, on the wire {seen}: {counters:?}"));
            }
        }
        // One that was found at the very end may not have been looked at.
        if counters.observations > self.received || counters.observations + 1 < self.received {
            let received = self.received;
            self.object("counters", || format!("observations: taken from the link {received}: {counters:?}"));
        }
        if counters.repeated_observations + counters.stale_observations > counters.observations {
            self.object("counters", || format!("{counters:?}"));
        }
    }

    /// Tells two runs apart.
    pub(crate) fn digest(&self) -> u64 {
        self.digest.finish()
    }
}
