//! How the loop runs.

use std::time::Duration;

use rcwm_models::wire::LinkSettings;

use super::{Fallback, TickLimits};
use crate::pacing::PacingSettings;
use crate::policy::SurpriseLimits;

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
    /// What is sent when the policy has nothing fit to send.
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
}
