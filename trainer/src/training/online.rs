//! What a run that acts tells whoever shows it or reads its metrics.

use serde::Serialize;

use super::{EvaluationLine, Line};

/// One episode of the policy, as a line of metrics tells it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeLine {
    /// Updates made when it ended.
    pub update: u64,
    /// `online`.
    pub phase: &'static str,
    pub episode: EpisodeFacts,
}

/// How an episode of the policy went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeFacts {
    /// Episodes that the policy has finished, this one included.
    pub number: u64,
    pub simulator: usize,
    /// Whether the task was solved at any step.
    pub success: bool,
    /// Sum of the rewards.
    #[serde(rename = "return")]
    pub total_reward: f64,
    /// Decisions in it.
    pub steps: u64,
    /// Decisions that the policy has made in all.
    pub policy_steps: u64,
    /// Steps of the environment that these were.
    pub environment_steps: u64,
}

/// Where a run stands, for whoever shows it.
#[derive(Debug, Clone)]
pub struct OnlineProgress<'a> {
    /// Updates made.
    pub updates: u64,
    /// Decisions that the policy has made.
    pub policy_steps: u64,
    /// The newest line of metrics, when there is a new one.
    pub line: Option<&'a Line>,
    /// The evaluation that has just been made.
    pub evaluation: Option<&'a EvaluationLine>,
    /// The episode that has just ended.
    pub episode: Option<&'a EpisodeLine>,
    /// Share of successes in the newest episodes; none before the first.
    pub success_rate: Option<f64>,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OnlineOutcome {
    /// Updates made in all.
    pub updates: u64,
    /// Decisions made in all.
    pub policy_steps: u64,
    /// Episodes finished in all.
    pub episodes: u64,
    /// Share of successes in the newest episodes.
    pub success_rate: Option<f64>,
    /// Actions that were not finite, and zeros in their place.
    pub refused_actions: u64,
    /// Whether it was stopped before its end; it can be resumed.
    pub interrupted: bool,
}
