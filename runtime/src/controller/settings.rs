//! How the loop runs.

use std::time::Duration;

use rcwm_models::wire::LinkSettings;

use super::{ControllerError, Fallback, SafetyFilter, TickLimits};
use crate::pacing::PacingSettings;
use crate::policy::{Policy, SurpriseLimits};

/// How the loop runs.
#[derive(Debug, Clone)]
pub struct ControllerSettings {
    pub link: LinkSettings,
    /// Ends after this many whole episodes.
    pub episodes_max: Option<u64>,
    /// Waits for another simulator when one has closed.
    pub stay: bool,
    /// Longest wait for the first observation; none waits for ever.
    pub first_timeout: Option<Duration>,
    /// Longest silence of a peer that was there; none waits for ever.
    pub silence_max: Option<Duration>,
    /// How to wait, and what is late.
    pub pacing: PacingSettings,
    /// How long the policy is done without.
    pub ticks: TickLimits,
    /// What is sent when the policy has nothing valid to send.
    pub fallback: Fallback,
    /// How much surprise is borne.
    pub surprise: SurpriseLimits,
    /// Largest change of each number from one action to the next, as a share of half of its range; at least 0.
    pub rate_max: Option<f32>,
}

impl ControllerSettings {
    /// Waits for ever, falls back to what the interface says, and bears any surprise.
    #[must_use]
    pub fn new(link: LinkSettings) -> Self {
        Self {
            link,
            episodes_max: None,
            stay: false,
            first_timeout: None,
            silence_max: None,
            pacing: PacingSettings::default(),
            ticks: TickLimits::default(),
            fallback: Fallback::Interface,
            surprise: SurpriseLimits::default(),
            rate_max: None,
        }
    }

    /// The safety filter of a policy under these settings.
    pub(super) fn safety_filter(&self, policy: &Policy) -> Result<SafetyFilter, ControllerError> {
        self.surprise.check(policy.manifest().kind)?;
        let limits = policy.limits();
        let all_are_positions = (0..limits.numbers()).all(|at| limits.is_absolute(at));
        match self.fallback {
            Fallback::Zero if all_are_positions => return Err(ControllerError::ZeroIsAPose),
            Fallback::Given(action) if action.len() != limits.numbers() => {
                let (found, expected) = (action.len(), limits.numbers());
                return Err(ControllerError::FallbackNumbers { found, expected });
            }
            Fallback::Given(action) => {
                // Brought into the limits it would be another pose than the one that was thought safe.
                let within = |at: &usize| (limits.low[*at]..=limits.high[*at]).contains(&action[*at]);
                if let Some(at) = (0..action.len()).find(|at| !within(at)) {
                    let (low, high) = (limits.low[at], limits.high[at]);
                    return Err(ControllerError::FallbackLimits { at: at + 1, found: action[at], low, high });
                }
            }
            _ => {}
        }
        Ok(SafetyFilter::new(limits, self.rate_max))
    }
}
