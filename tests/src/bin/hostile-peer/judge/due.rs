//! When a stand-in is due, as the controller's looks at its clock tell.

use super::Judge;

/// The controller looks at the link so often, at most, before it sends a stand-in that is due.
pub(super) const LOOKS_MAX: u32 = 3;

/// A stand-in that is due.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Due {
    is_due: bool,
    looks: u32,
}

impl Judge {
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
        if !left && self.fallbacks >= u64::from(fallbacks_max) {
            // It falls silent, for certain as all of them were sent.
            self.silent = true;
            if let Some(newest) = &mut self.newest {
                newest.exhausted = true;
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
}
