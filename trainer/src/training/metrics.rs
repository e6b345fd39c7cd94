use serde::Serialize;

use crate::learning::LossValues;

/// One line of metrics: means over the updates since the line before.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metrics {
    /// Updates made so far.
    pub update: u64,
    /// `warm_up` or `mask_free`.
    pub phase: &'static str,
    /// The losses before their factors.
    pub losses: LossValues,
    /// Norm of the gradients before clipping.
    pub gradient_norm: f64,
    /// Updates a second.
    pub updates_per_second: f64,
    /// Share of the time spent waiting for batches.
    pub waiting_share: f64,
}

/// The line of a checkpoint: mask-free losses on the held-out episodes, by the same batches and the same noise every time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HeldOutLosses {
    /// Updates made so far.
    pub update: u64,
    /// The losses before their factors.
    pub held_out: LossValues,
    /// Whether this is the best checkpoint so far.
    pub best: bool,
}

impl Metrics {
    /// Every number under its name for TensorBoard.
    pub(super) fn scalars(&self) -> Vec<(String, f64)> {
        let mut scalars = loss_scalars("losses", &self.losses);
        scalars.push(("gradient_norm".to_owned(), self.gradient_norm));
        scalars.push(("speed/updates_per_second".to_owned(), self.updates_per_second));
        scalars.push(("speed/waiting_share".to_owned(), self.waiting_share));
        scalars
    }
}

impl HeldOutLosses {
    /// Every number under its name for TensorBoard.
    pub(super) fn scalars(&self) -> Vec<(String, f64)> {
        loss_scalars("held_out", &self.held_out)
    }
}

fn loss_scalars(group: &str, losses: &LossValues) -> Vec<(String, f64)> {
    let always = [
        ("total", Some(losses.total)),
        ("image", Some(losses.image)),
        ("robot_mask", losses.robot_mask),
        ("reward", Some(losses.reward)),
        ("continue", Some(losses.continues)),
        ("robot_kl", Some(losses.robot_kl)),
        ("environment_kl", losses.environment_kl),
    ];
    always.into_iter().filter_map(|(name, value)| Some((format!("{group}/{name}"), value?))).collect()
}
