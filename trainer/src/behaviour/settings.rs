use serde::{Deserialize, Serialize};

use super::Horizon;
use crate::learning::AdamSettings;

/// How actor and critic learn (paper, Table 2).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BehaviourSettings {
    /// How far is imagined and how the future is discounted.
    pub horizon: Horizon,
    /// eta: factor of the actor's entropy.
    pub entropy_scale: f64,
    /// Share of the newest batch in the average range of the returns.
    pub return_range_share: f64,
    /// Quantile of the returns at the range's lower end.
    pub return_range_low: f64,
    /// Quantile of the returns at the range's upper end.
    pub return_range_high: f64,
    /// Share of the critic that is mixed into its slow copy before each update.
    pub slow_critic_share: f64,
    /// Whether the actor's loss moves the critic too. The definition says no; the update that the authors' reference file records
    /// does it, and parity compares like with like.
    pub actor_loss_reaches_critic: bool,
    /// The actor's optimiser.
    pub actor: AdamSettings,
    /// The critic's optimiser.
    pub critic: AdamSettings,
}

impl Default for BehaviourSettings {
    fn default() -> Self {
        let adam =
            AdamSettings { learning_rate: 3e-5, eps: 1e-5, clip_norm: 100.0, ..AdamSettings::default() };
        Self {
            horizon: Horizon::default(),
            entropy_scale: 3e-4,
            return_range_share: 0.01,
            return_range_low: 0.05,
            return_range_high: 0.95,
            slow_critic_share: 0.02,
            actor_loss_reaches_critic: false,
            actor: adam.clone(),
            critic: adam,
        }
    }
}
