//! A message as the judge remembers it, and how far its clock is believed.

use rcwm_models::wire::{Observation, ObservationFlags};

use super::Vector;

/// The shortest period that the runtime believes, in ns.
const PERIOD_NS_MIN: u64 = 50_000;
/// Largest component of an executed action, rounding included.
const EXECUTED_MAX: f32 = 1.001;

/// What the judge remembers of a message.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Heard {
    pub(super) publisher: u128,
    pub(super) sequence: u64,
    pub(super) episode: u64,
    pub(super) flags: ObservationFlags,
    pub(super) period_ns: u64,
    pub(super) scheduled_ns: u64,
    pub(super) published_ns: u64,
    pub(super) executed: Vector,
    pub(super) is_finite: bool,
    pub(super) received_ns: u64,
    /// When the controller looked at it at the latest, once that is known.
    pub(super) taken_ns: u64,
}

impl Heard {
    pub(crate) fn new(publisher: u128, message: &Observation<'_>, received_ns: u64) -> Self {
        Self {
            publisher,
            sequence: message.sequence,
            episode: message.episode,
            flags: ObservationFlags(message.flags),
            period_ns: message.period_ns,
            scheduled_ns: message.scheduled_ns,
            published_ns: message.published_ns,
            executed: message.executed_action(),
            is_finite: message.is_finite(),
            received_ns,
            taken_ns: received_ns,
        }
    }

    /// Whether what it says was executed is something that a robot can have executed.
    pub(super) fn is_executable(&self) -> bool {
        self.executed.iter().all(|x| x.abs() <= EXECUTED_MAX)
    }

    /// Whether the policy can be asked about it.
    pub(super) fn is_fit(&self) -> bool {
        self.is_finite && self.is_executable()
    }

    pub(super) fn is_stale_at(&self, now_ns: u64, stale_periods: f64) -> bool {
        let longest = (self.period_ns.max(PERIOD_NS_MIN) as f64 * stale_periods) as u64;
        self.period_ns > 0 && now_ns.saturating_sub(self.scheduled_ns) > longest
    }

    /// From when its period counts at the earliest and at the latest, as far as a peer's clock is believed: nothing was scheduled or
    /// published later than it was received.
    fn base_ns(&self) -> (u64, u64) {
        let published_ns = self.published_ns.min(self.received_ns);
        let scheduled_ns = if self.scheduled_ns > self.received_ns { 0 } else { self.scheduled_ns };
        (scheduled_ns.max(published_ns), self.scheduled_ns.max(self.published_ns).min(self.taken_ns))
    }

    /// Whether its clock can be read in a way that makes it too old.
    pub(super) fn may_be_stale_at(&self, now_ns: u64, stale_periods: f64) -> bool {
        let scheduled_ns = self.scheduled_ns.min(self.published_ns);
        Self { scheduled_ns, ..*self }.is_stale_at(now_ns, stale_periods)
    }

    /// When the observation `ticks` after it is missing, at the earliest and at the latest.
    pub(super) fn due_ns(&self, ticks: u64, grace_periods: f64) -> (u64, u64) {
        let period_ns = self.period_ns.max(PERIOD_NS_MIN);
        let later_ns =
            period_ns.saturating_mul(ticks).saturating_add((period_ns as f64 * grace_periods) as u64);
        let (earliest_ns, latest_ns) = self.base_ns();
        (earliest_ns.saturating_add(later_ns), latest_ns.saturating_add(later_ns))
    }
}
