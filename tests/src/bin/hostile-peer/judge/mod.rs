//! What every action on the wire must be, told from what went over the wire alone.
//!
//! The judge sees each message as the controller takes it from the link, each action as the peer receives it, and each look of the
//! controller at its clock. It knows the contract (`docs/controller.md`), not the code.

mod actions;
mod due;
mod heard;
mod messages;
#[cfg(test)]
mod tests;
mod values;

use std::hash::{DefaultHasher, Hasher};

use rcwm_models::wire::{Action, ActionValues};
use rcwm_runtime::controller::Counters;

use due::Due;
pub(crate) use heard::Heard;

use crate::bundles::Known;
use crate::scenario::Setup;

type Vector = ActionValues;

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
    /// It may have turned stale, and what was sent be the stand-in for it.
    stood_in_for: bool,
    /// Another was found in the middle of its tick.
    overtaken: bool,
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
    /// What messages since the last action that got none say was executed.
    unanswered_executed: Vec<Vector>,
    last: Option<Action>,
    /// `last` belongs to the running episode.
    in_episode: bool,
    /// Something was sent, or is said to have been executed, that can be held.
    is_held: bool,
    /// Stand-ins and fallbacks since the policy's last answer.
    imagined: u64,
    fallbacks: u64,
    /// So many more may have been counted: those of messages that were found in the middle of a tick, which is not sent then, and those
    /// before what may have been a new beginning.
    unsent: u64,
    /// The controller has fallen silent since, and begins anew with the next message.
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
            unanswered_executed: Vec::new(),
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
