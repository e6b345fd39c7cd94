//! One episode, as the report tells it.

use rcwm_models::tasks::task_name;
use rcwm_models::wire::{ObservationFlags, ObservationHeader};
use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EpisodeResult {
    /// Its number at the simulator.
    pub episode: u64,
    pub task: &'static str,
    /// Step of the last observation received; the first of an episode is step 0.
    pub steps: u32,
    /// Sum of rewards.
    #[serde(rename = "return")]
    pub return_sum: f64,
    /// The task counted as solved at some step.
    pub success: bool,
    /// Seen from its first observation on.
    pub from_first: bool,
    /// Seen from its first to its last observation.
    pub whole: bool,
}

impl EpisodeResult {
    /// An episode that begins with this observation, which is not counted yet.
    #[must_use]
    pub fn start(observation: &ObservationHeader) -> Self {
        Self {
            episode: observation.episode,
            task: task_name(observation.task),
            steps: 0,
            return_sum: 0.0,
            success: false,
            from_first: observation.is(ObservationFlags::FIRST),
            whole: false,
        }
    }

    /// Counts an observation.
    pub fn add(&mut self, observation: &ObservationHeader) {
        self.steps = observation.step;
        self.success |= observation.is(ObservationFlags::SUCCESS);
        if observation.reward.is_finite() {
            self.return_sum += f64::from(observation.reward);
        }
    }
}

impl EpisodeResult {
    /// One line for people.
    #[must_use]
    pub fn line(&self) -> String {
        let Self { episode, task, steps, return_sum, success, whole, .. } = self;
        let outcome = if *success { "success" } else { "no success" };
        let cut = if *whole { "" } else { " (cut)" };
        format!("episode {episode:<3} {task:<20} {steps:>4} steps  return {return_sum:>9.2}  {outcome}{cut}")
    }
}
