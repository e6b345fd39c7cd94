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

use rcwm_models::wire::{ObservationFlags, ObservationHeader};

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
    pub fn of(observation: &ObservationHeader, received_ns: u64) -> Self {
        let ObservationHeader { scheduled_ns, published_ns, period_ns, .. } = *observation;
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
    pub fn observed(&mut self, observation: &ObservationHeader, received_ns: u64) {
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
    pub fn is_stale(&self, observation: &ObservationHeader, received_ns: u64) -> bool {
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
mod tests;
