//! Separate episodes that a run that acts is judged by, on layouts that it never learns from (paper, Fig. 6).

use std::sync::atomic::AtomicBool;

use serde::{Deserialize, Serialize};

use super::{EvaluationSettings, TrainingError, TrainingSettings};
use crate::evaluation::{ClosedLoopError, ClosedLoopSettings, TRAINER_ENGINE, closed_loop_in_trainer};
use crate::model::agent::Agent;

/// An evaluation as a line of metrics tells it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvaluationLine {
    /// Updates made.
    pub update: u64,
    /// `online`.
    pub phase: &'static str,
    /// How it went.
    pub evaluation: EvaluationFacts,
}

/// How an evaluation went.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluationFacts {
    /// Decisions that the policy had made while it learned.
    pub policy_steps: u64,
    /// Steps of the environment that these were.
    pub environment_steps: u64,
    /// The set of layouts.
    pub layouts: String,
    pub episodes: u64,
    /// Episodes in which the task was solved at some step.
    pub successes: u64,
    /// Mean return of an episode.
    pub return_mean: f64,
    /// Of the clock.
    pub seconds: f64,
}

/// Runs the episodes with the most probable actions; `None` when it was stopped in between.
pub(super) fn evaluate(
    agent: Agent,
    settings: &TrainingSettings,
    (policy_steps, environment_steps): (u64, u64),
    stop: &AtomicBool,
) -> Result<Option<EvaluationFacts>, TrainingError> {
    let finetune = &settings.finetune;
    let EvaluationSettings { episodes, layouts, .. } = finetune.evaluation.clone();
    let simulators = finetune.simulators.max(1) as u64;
    let closed_loop = ClosedLoopSettings {
        task: settings.task.clone(),
        episodes,
        layouts: layouts.clone(),
        seed: settings.seed,
        steps_max: finetune.episode_steps,
        disturb: finetune.disturb.clone(),
        engine: TRAINER_ENGINE.to_owned(),
        sample: false,
        simulators,
        simulator: None,
        runtime: None,
    };
    match closed_loop_in_trainer(agent, &closed_loop, stop, |_| ()) {
        Ok(found) => Ok(Some(EvaluationFacts {
            policy_steps,
            environment_steps,
            layouts,
            episodes,
            successes: found.successes as u64,
            return_mean: found.return_mean,
            seconds: found.seconds,
        })),
        Err(ClosedLoopError::Interrupted) => Ok(None),
        Err(error) => Err(TrainingError::Evaluation(Box::new(error))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_evaluation_is_due_before_any_step_and_none_where_there_are_none() {
        let settings = EvaluationSettings { every_steps: 100, ..EvaluationSettings::default() };
        assert_eq!([0, 99, 100, 250].map(|steps| settings.due(steps)), [1, 1, 2, 3]);
        assert_eq!(EvaluationSettings::default().due(1000), 0);
    }

    #[test]
    fn settings_that_cannot_work_are_refused_by_name() {
        let of = |layouts: &str, episodes| EvaluationSettings {
            every_steps: 1,
            layouts: layouts.into(),
            episodes,
        };
        assert!(of("learnt", 1).invalid().unwrap().contains("\"learnt\""));
        assert!(of("choosing", 0).invalid().unwrap().contains("episodes = 0"));
        assert_eq!(of("reporting", 1).invalid(), None);
    }
}
