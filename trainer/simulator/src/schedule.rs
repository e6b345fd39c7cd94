//! The fixed clock of real-time pace: ticks at absolute times, never two in a burst.

use rcwm_models::wire::clock::monotonic_ns;
use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec};

const NS_PER_S: u64 = 1_000_000_000;

/// Ticks at `first + k * period`.
#[derive(Debug, Clone)]
pub struct Schedule {
    period_ns: u64,
    next_ns: u64,
}

impl Schedule {
    /// A schedule whose first tick is at `first_ns`.
    ///
    /// # Panics
    /// When the period is zero.
    #[must_use]
    pub fn with_first_tick(first_ns: u64, period_ns: u64) -> Self {
        assert!(period_ns > 0, "the period of a fixed clock is positive");
        Self { period_ns, next_ns: first_ns }
    }

    /// When the next tick is due.
    #[must_use]
    pub fn next_ns(&self) -> u64 {
        self.next_ns
    }

    /// Ends the present tick at `now_ns`; returns how many further ticks are lost because they were already due.
    pub fn advance(&mut self, now_ns: u64) -> u64 {
        self.next_ns += self.period_ns;
        let missed = match now_ns.checked_sub(self.next_ns) {
            Some(late_ns) => late_ns / self.period_ns + 1,
            None => 0,
        };
        self.next_ns += missed * self.period_ns;
        missed
    }
}

/// Sleeps until an absolute time of the monotonic clock; returns at once where it has passed.
pub fn sleep_until(time_ns: u64) {
    let time = Timespec { tv_sec: (time_ns / NS_PER_S) as i64, tv_nsec: (time_ns % NS_PER_S) as i64 };
    // A signal ends the sleep early: the deadline is absolute, so sleeping again is exact.
    while monotonic_ns() < time_ns {
        if clock_nanosleep_absolute(ClockId::Monotonic, &time).is_ok() {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_keep_to_the_schedule_when_the_work_is_short() {
        let mut schedule = Schedule::with_first_tick(110, 10);
        assert_eq!(schedule.next_ns(), 110);
        assert_eq!(schedule.advance(117), 0);
        assert_eq!(schedule.advance(129), 0);
        assert_eq!(schedule.next_ns(), 130);
    }

    #[test]
    fn late_ticks_are_skipped_and_counted_and_the_grid_is_kept() {
        let mut schedule = Schedule::with_first_tick(110, 10);
        assert_eq!(schedule.advance(120), 1);
        assert_eq!(schedule.next_ns(), 130);
        assert_eq!(schedule.advance(175), 4);
        assert_eq!(schedule.next_ns(), 180);
    }

    #[test]
    fn a_deadline_in_the_past_does_not_sleep() {
        sleep_until(1);
        let soon = monotonic_ns() + 2_000_000;
        sleep_until(soon);
        assert!(monotonic_ns() >= soon);
    }
}
