//! When the next observation is due, how to wait for it, and when it counts as late.
//!
//! Three times of an observation are kept apart: when it was *scheduled*, when it was *published*, and when it was *received*. With
//! the period P that it carries, the next one is scheduled at `scheduled + P`. A simulator publishes somewhat after its schedule
//! (it has to step and to render first), so the next one is *expected* a period after the last was published, and it is *overdue*
//! a grace later:
//!
//! ```text
//!  scheduled   published            scheduled+P   expected        overdue
//! -----|-----------|---------------------|------------|---------------|------->
//!      |<-- lag -->|<-------------- P -------------->|<--- grace --->|
//!                    blocks      | gets ready | spins |   blocks
//! ```
//!
//! Waiting blocks until shortly before the expected time, gets ready for what will come, polls from there to shortly after the expected
//! time, and blocks again. How long getting ready takes is learnt from how long it took, and when it is to be done by from how soon after their schedule
//! observations have come lately. A peer whose clock is ahead is not believed: nothing was scheduled or published later than it was received. Where ticks were slept through, only the newest is made up for: the others are counted, never run in a burst. In lock-step nothing is due.

use std::time::Duration;

use rcwm_models::wire::{Observation, ObservationFlags};

/// Shortest period that is believed, in ns: one that a peer has garbled must not make the loop run wild.
const PERIOD_NS_MIN: u64 = 50_000;
/// Getting ready begins at most this share of a period before polling, whatever it takes.
const LEAD_SHARE: u64 = 4;
/// A wait for which nothing is due.
const NOTHING_DUE: Duration = Duration::from_secs(3600);

/// How to wait, and what is late.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PacingSettings {
    /// Polls so long before and after the expected time; in lock-step so long from the start of a wait.
    pub spin: Duration,
    /// Whether to get ready for an observation before it is expected.
    pub gets_ready: bool,
    /// An observation is overdue so many periods after it was expected.
    pub grace_periods: f64,
    /// An observation is stale when it was scheduled more than so many periods ago as it arrives.
    pub stale_periods: f64,
}

impl Default for PacingSettings {
    fn default() -> Self {
        Self { spin: Duration::from_micros(50), gets_ready: true, grace_periods: 0.5, stale_periods: 2.0 }
    }
}

/// What to do now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Plan {
    /// Wait for a message, polling for `spin` first; then ask again.
    Wait {
        /// How long to poll.
        spin: Duration,
        /// The longest wait, polling included.
        timeout: Duration,
    },
    /// An observation will come soon: get ready for it, say [`Pacing::got_ready`], then ask again.
    GetReady,
    /// An observation is missing: see [`Pacing::take_overdue`].
    Overdue,
}

/// A tick whose observation has not come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Missing {
    /// The sequence that the observation would have had.
    pub sequence: u64,
    /// When it was scheduled, CLOCK_MONOTONIC in ns.
    pub scheduled_ns: u64,
    /// Ticks before it that were slept through.
    pub skipped: u64,
}

/// When an observation was scheduled and published, as far as that can be: both are over when it is received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamps {
    /// When it was scheduled, CLOCK_MONOTONIC in ns.
    pub scheduled_ns: u64,
    /// When it was published.
    pub published_ns: u64,
    /// How far the peer's clock is ahead at least; 0 where nothing tells that it is.
    pub ahead_ns: u64,
}

impl Stamps {
    /// Those of an observation that was received at `received_ns`.
    #[must_use]
    pub fn of(observation: &Observation, received_ns: u64) -> Self {
        let Observation { scheduled_ns, published_ns, period_ns, .. } = *observation;
        let published_ahead_ns = published_ns.saturating_sub(received_ns);
        // One may be published a little before it is due.
        let scheduled_ahead_ns = scheduled_ns.saturating_sub(received_ns.saturating_add(period_ns));
        let published_ns = published_ns.min(received_ns);
        Self {
            scheduled_ns: if scheduled_ns > received_ns { published_ns } else { scheduled_ns },
            published_ns,
            ahead_ns: published_ahead_ns.max(scheduled_ahead_ns),
        }
    }
}

/// The schedule of the peer, as far as its last observation tells.
#[derive(Debug, Clone, Copy)]
pub struct Pacing {
    settings: PacingSettings,
    schedule: Option<Schedule>,
    /// How long before polling to get ready.
    lead_ns: u64,
    /// How soon after its schedule an observation may be published, from the last ones.
    soonest_ns: Option<u64>,
}

#[derive(Debug, Clone, Copy)]
struct Schedule {
    sequence: u64,
    scheduled_ns: u64,
    /// The later of scheduled and published.
    base_ns: u64,
    /// How much sooner than expected the next one may come.
    sooner_ns: u64,
    period_ns: u64,
    grace_ns: u64,
    /// Ticks after `sequence` that were found overdue.
    overdue: u64,
    /// The tick after `sequence` that was got ready for; 0 for none.
    ready: u64,
}

impl Schedule {
    /// Ticks after the last observation that a sequence is left for: a stand-in never answers one that is there.
    fn ticks_max(&self) -> u64 {
        u64::MAX - self.sequence
    }

    /// When the observation `ticks` after the last is expected.
    fn expected_ns(&self, ticks: u64) -> u64 {
        self.base_ns.saturating_add(self.period_ns.saturating_mul(ticks))
    }
}

impl Pacing {
    /// Nothing is due yet.
    #[must_use]
    pub fn new(settings: PacingSettings) -> Self {
        Self { settings, schedule: None, lead_ns: 0, soonest_ns: None }
    }

    /// Takes the schedule over from an observation that was received at `received_ns`. After the last of an episode nothing is due: a reset takes its time.
    pub fn observed(&mut self, observation: &Observation, received_ns: u64) {
        if observation.period_ns == 0 || observation.is(ObservationFlags::LAST) {
            self.schedule = None;
            return;
        }
        let period_ns = observation.period_ns.max(PERIOD_NS_MIN);
        let Stamps { scheduled_ns, published_ns, .. } = Stamps::of(observation, received_ns);
        let lag_ns = published_ns.saturating_sub(scheduled_ns);
        // Down at once, up slowly.
        let soonest_ns = self
            .soonest_ns
            .map_or(lag_ns, |soonest| lag_ns.min(soonest.saturating_add(lag_ns.abs_diff(soonest) / 32)));
        self.soonest_ns = Some(soonest_ns);
        self.schedule = Some(Schedule {
            sequence: observation.sequence,
            scheduled_ns,
            base_ns: scheduled_ns.max(published_ns),
            sooner_ns: lag_ns - soonest_ns,
            period_ns,
            grace_ns: share(period_ns, self.settings.grace_periods),
            overdue: 0,
            ready: 0,
        });
    }

    /// Says that what [`Plan::GetReady`] asked for is done, and how long it took. The next time it begins so long before polling, and a
    /// little more; a longer time is forgotten slowly.
    pub fn got_ready(&mut self, took: Duration) {
        let took_ns = u64::try_from(took.as_nanos()).unwrap_or(u64::MAX);
        self.lead_ns = (self.lead_ns - self.lead_ns / 64).max(took_ns.saturating_add(took_ns / 4));
        if let Some(schedule) = &mut self.schedule {
            schedule.ready = schedule.overdue + 1;
        }
    }

    /// Nothing is due any more.
    pub fn rest(&mut self) {
        self.schedule = None;
    }

    /// Whether an observation was scheduled so long ago that an answer to it would do harm. Never so in lock-step, where the
    /// publisher waits.
    #[must_use]
    pub fn is_stale(&self, observation: &Observation, received_ns: u64) -> bool {
        let age_ns = received_ns.saturating_sub(Stamps::of(observation, received_ns).scheduled_ns);
        observation.period_ns > 0
            && age_ns > share(observation.period_ns.max(PERIOD_NS_MIN), self.settings.stale_periods)
    }

    /// What to do at `now_ns`.
    #[must_use]
    pub fn plan(&self, now_ns: u64) -> Plan {
        let spin = self.settings.spin;
        let schedule = self.schedule.filter(|schedule| schedule.overdue < schedule.ticks_max());
        let Some(schedule) = schedule else { return Plan::Wait { spin, timeout: NOTHING_DUE } };
        let expected_ns = schedule.expected_ns(schedule.overdue + 1);
        let overdue_ns = expected_ns.saturating_add(schedule.grace_ns);
        if now_ns >= overdue_ns {
            return Plan::Overdue;
        }
        let spin_ns = (spin.as_nanos() as u64).min(schedule.grace_ns);
        let until = |time_ns: u64| Duration::from_nanos(time_ns - now_ns);
        let (spin_from_ns, spin_until_ns) =
            (expected_ns.saturating_sub(spin_ns), expected_ns.saturating_add(spin_ns));
        let lead_ns = self.lead_ns.saturating_add(schedule.sooner_ns).min(schedule.period_ns / LEAD_SHARE);
        let ready_from_ns = spin_from_ns.saturating_sub(lead_ns);
        // Once it is expected, what comes is not to wait for this.
        let is_ready =
            !self.settings.gets_ready || schedule.ready > schedule.overdue || now_ns >= expected_ns;
        if now_ns < ready_from_ns {
            Plan::Wait { spin: Duration::ZERO, timeout: until(ready_from_ns) }
        } else if !is_ready {
            Plan::GetReady
        } else if now_ns < spin_from_ns {
            Plan::Wait { spin: Duration::ZERO, timeout: until(spin_from_ns) }
        } else if now_ns < spin_until_ns {
            Plan::Wait { spin: until(spin_until_ns), timeout: until(spin_until_ns) }
        } else {
            Plan::Wait { spin: Duration::ZERO, timeout: until(overdue_ns) }
        }
    }

    /// The newest tick that is overdue at `now_ns`; each is given once.
    pub fn take_overdue(&mut self, now_ns: u64) -> Option<Missing> {
        let schedule = self.schedule.as_mut()?;
        let over_ns = now_ns.checked_sub(schedule.base_ns)?.checked_sub(schedule.grace_ns)?;
        let newest = (over_ns / schedule.period_ns).min(schedule.ticks_max());
        let skipped = newest.checked_sub(schedule.overdue + 1)?;
        schedule.overdue = newest;
        Some(Missing {
            sequence: schedule.sequence + newest,
            scheduled_ns: schedule.scheduled_ns.saturating_add(schedule.period_ns.saturating_mul(newest)),
            skipped,
        })
    }
}

/// So many periods, in ns.
fn share(period_ns: u64, periods: f64) -> u64 {
    (period_ns as f64 * periods) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NS: u64 = 1_000_000;
    const PUBLISHED_NS: u64 = 10_200_000;

    fn settings() -> PacingSettings {
        PacingSettings { spin: Duration::from_nanos(100_000), ..PacingSettings::default() }
    }

    /// Sequence 7, scheduled at 10 ms, published 0.2 ms later, every ms.
    fn observation() -> Observation {
        let mut observation = Observation::zeroed();
        (observation.sequence, observation.period_ns) = (7, PERIOD_NS);
        (observation.scheduled_ns, observation.published_ns) = (10_000_000, PUBLISHED_NS);
        observation
    }

    fn after(observation: &Observation) -> Pacing {
        let mut pacing = Pacing::new(settings());
        pacing.observed(observation, observation.published_ns);
        pacing
    }

    fn wait(spin_ns: u64, timeout_ns: u64) -> Plan {
        Plan::Wait { spin: Duration::from_nanos(spin_ns), timeout: Duration::from_nanos(timeout_ns) }
    }

    #[test]
    fn it_blocks_then_polls_around_the_expected_time_then_blocks_until_the_grace_is_over() {
        let pacing = after(&observation());
        let expected_ns = PUBLISHED_NS + PERIOD_NS;
        assert_eq!(pacing.plan(PUBLISHED_NS), wait(0, 900_000));
        assert_eq!(pacing.plan(expected_ns - 100_000), Plan::GetReady);
        assert_eq!(pacing.plan(expected_ns), wait(100_000, 100_000), "too late to get ready");
        let pacing = ready(pacing, 0);
        assert_eq!(pacing.plan(expected_ns - 100_000), wait(200_000, 200_000));
        assert_eq!(pacing.plan(expected_ns + 99_999), wait(1, 1));
        assert_eq!(pacing.plan(expected_ns + 100_000), wait(0, 400_000));
        assert_eq!(pacing.plan(expected_ns + 500_000), Plan::Overdue);
    }

    fn ready(mut pacing: Pacing, took_ns: u64) -> Pacing {
        pacing.got_ready(Duration::from_nanos(took_ns));
        pacing
    }

    #[test]
    fn it_gets_ready_once_a_tick_as_long_before_as_that_takes() {
        let mut pacing = ready(after(&observation()), 80_000);
        let polls_ns = PUBLISHED_NS + PERIOD_NS - 100_000;
        assert_eq!(pacing.plan(polls_ns - 100_000), wait(0, 100_000), "ready for this one already");
        pacing.observed(&observation(), PUBLISHED_NS);
        assert_eq!(pacing.plan(polls_ns - 100_001), wait(0, 1), "a quarter more than it took");
        assert_eq!(pacing.plan(polls_ns - 100_000), Plan::GetReady);
        let mut pacing = ready(pacing, 80_000);
        assert!(pacing.take_overdue(PUBLISHED_NS + PERIOD_NS * 3 / 2).is_some());
        assert_eq!(pacing.plan(polls_ns + PERIOD_NS - 1), Plan::GetReady, "the one that was missing is over");
    }

    #[test]
    fn it_gets_ready_for_an_observation_that_comes_as_soon_as_others_came() {
        let mut pacing = ready(after(&observation()), 80_000);
        let mut late = observation();
        late.published_ns += 64_000;
        pacing.observed(&late, late.published_ns);
        let polls_ns = late.published_ns + PERIOD_NS - 100_000;
        // 64 us sooner than expected, of which a 32nd is forgotten.
        assert_eq!(pacing.plan(polls_ns - 100_000 - 62_001), wait(0, 1));
        assert_eq!(pacing.plan(polls_ns - 100_000 - 62_000), Plan::GetReady);
        for _ in 0..500 {
            pacing.observed(&late, late.published_ns);
        }
        assert_ne!(pacing.plan(polls_ns - 100_100), Plan::GetReady, "they come later now");
        late.published_ns += 100 * PERIOD_NS;
        pacing.observed(&late, late.published_ns);
        let polls_ns = late.published_ns + PERIOD_NS - 100_000;
        assert_eq!(pacing.plan(polls_ns - PERIOD_NS / 4 - 1), wait(0, 1), "never earlier than that");
    }

    #[test]
    fn it_does_not_get_ready_where_that_is_not_wanted() {
        let mut pacing = Pacing::new(PacingSettings { gets_ready: false, ..settings() });
        pacing.observed(&observation(), PUBLISHED_NS);
        assert_eq!(pacing.plan(PUBLISHED_NS + PERIOD_NS - 100_000), wait(200_000, 200_000));
    }

    #[test]
    fn getting_ready_never_takes_more_than_a_quarter_of_the_period_ahead_and_is_forgotten_in_time() {
        let mut pacing = ready(after(&observation()), 50 * PERIOD_NS);
        let polls_ns = PUBLISHED_NS + PERIOD_NS - 100_000;
        pacing.observed(&observation(), PUBLISHED_NS);
        assert_eq!(pacing.plan(polls_ns - PERIOD_NS / 4 - 1), wait(0, 1));
        for _ in 0..600 {
            pacing.got_ready(Duration::from_nanos(80_000));
        }
        pacing.observed(&observation(), PUBLISHED_NS);
        assert_eq!(pacing.plan(polls_ns - 100_001), wait(0, 1));
    }

    #[test]
    fn a_missing_tick_is_given_once_with_its_own_schedule() {
        let mut pacing = after(&observation());
        let overdue_ns = PUBLISHED_NS + PERIOD_NS * 3 / 2;
        assert_eq!(pacing.take_overdue(overdue_ns - 1), None);
        let missing = Missing { sequence: 8, scheduled_ns: 11_000_000, skipped: 0 };
        assert_eq!(pacing.take_overdue(overdue_ns), Some(missing));
        assert_eq!(pacing.take_overdue(overdue_ns + PERIOD_NS - 1), None);
        assert_eq!(pacing.take_overdue(overdue_ns + PERIOD_NS).map(|missing| missing.sequence), Some(9));
    }

    #[test]
    fn ticks_that_were_slept_through_are_counted_and_not_made_up_for() {
        let mut pacing = after(&observation());
        let late_ns = PUBLISHED_NS + 10 * PERIOD_NS;
        let missing = Missing { sequence: 16, scheduled_ns: 19_000_000, skipped: 8 };
        assert_eq!(pacing.take_overdue(late_ns), Some(missing));
        assert_eq!(pacing.take_overdue(late_ns), None);
        assert_ne!(pacing.plan(late_ns), Plan::Overdue);
    }

    #[test]
    fn nothing_is_due_in_lock_step_after_a_last_one_and_at_rest() {
        let idle = Plan::Wait { spin: settings().spin, timeout: NOTHING_DUE };
        let mut lockstep = observation();
        lockstep.period_ns = 0;
        let mut last = observation();
        last.flags = ObservationFlags::LAST.0;
        let mut resting = after(&observation());
        resting.rest();
        for mut pacing in [after(&lockstep), after(&last), resting] {
            assert_eq!((pacing.plan(u64::MAX), pacing.take_overdue(u64::MAX)), (idle, None));
        }
    }

    #[test]
    fn stale_is_what_was_scheduled_more_than_two_periods_before_it_came() {
        let pacing = Pacing::new(settings());
        let mut seen = observation();
        assert!(!pacing.is_stale(&seen, seen.scheduled_ns + 2 * PERIOD_NS));
        assert!(pacing.is_stale(&seen, seen.scheduled_ns + 2 * PERIOD_NS + 1));
        assert!(!pacing.is_stale(&seen, 0), "one from the future is not stale");
        seen.period_ns = 0;
        assert!(!pacing.is_stale(&seen, u64::MAX));
    }

    #[test]
    fn nothing_was_scheduled_or_published_later_than_it_was_received() {
        let (received_ns, late_ns) = (PUBLISHED_NS + 50_000, PUBLISHED_NS + 3 * PERIOD_NS);
        let seen = |scheduled_ns, published_ns| Observation { scheduled_ns, published_ns, ..observation() };
        let stamps = |seen: Observation| {
            let Stamps { scheduled_ns, published_ns, ahead_ns } = Stamps::of(&seen, received_ns);
            (scheduled_ns, published_ns, ahead_ns)
        };
        assert_eq!(stamps(observation()), (10_000_000, PUBLISHED_NS, 0));
        // Published a little before it was due: no clock is ahead.
        assert_eq!(stamps(seen(received_ns + 1, PUBLISHED_NS)), (PUBLISHED_NS, PUBLISHED_NS, 0));
        let scheduled_ahead = seen(late_ns, PUBLISHED_NS);
        assert_eq!(stamps(scheduled_ahead), (PUBLISHED_NS, PUBLISHED_NS, late_ns - received_ns - PERIOD_NS));
        assert_eq!(stamps(seen(u64::MAX, u64::MAX)), (received_ns, received_ns, u64::MAX - received_ns));
        for ahead in [scheduled_ahead, seen(u64::MAX, u64::MAX), seen(0, u64::MAX)] {
            let mut pacing = Pacing::new(settings());
            pacing.observed(&ahead, received_ns);
            assert_eq!(pacing.plan(received_ns + PERIOD_NS * 3 / 2), Plan::Overdue, "{ahead:?}");
        }
    }

    #[test]
    fn nothing_is_due_after_the_last_sequence() {
        let mut seen = observation();
        let idle = Plan::Wait { spin: settings().spin, timeout: NOTHING_DUE };
        for (sequence, left) in [(u64::MAX, 0), (u64::MAX - 2, 2)] {
            seen.sequence = sequence;
            let mut pacing = after(&seen);
            let given = (2..20).filter_map(|ticks| pacing.take_overdue(PUBLISHED_NS + ticks * PERIOD_NS));
            let given: Vec<u64> = given.map(|missing| missing.sequence).collect();
            assert_eq!(given, (1..=left).map(|tick| sequence + tick).collect::<Vec<_>>());
            assert_eq!(pacing.plan(u64::MAX), idle);
        }
    }

    #[test]
    fn absurd_periods_neither_overflow_nor_run_wild() {
        let mut seen = observation();
        seen.period_ns = u64::MAX;
        assert_ne!(after(&seen).plan(u64::MAX - 1), Plan::Overdue);
        seen.period_ns = 1;
        let mut pacing = after(&seen);
        let mut ticks = 0;
        for now_ns in (PUBLISHED_NS..PUBLISHED_NS + PERIOD_NS).step_by(1000) {
            ticks += u64::from(pacing.take_overdue(now_ns).is_some());
        }
        assert!(ticks <= PERIOD_NS / PERIOD_NS_MIN, "{ticks}");
    }
}
