//! How models are judged on recorded trajectories.

use serde::{Deserialize, Serialize};

use super::OtherActions;

/// How latents are chosen from their distributions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Latents {
    /// Drawn, by the seed.
    Sample,
    /// The most probable class.
    Mode,
}

impl Latents {
    /// Its name in files and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sample => "sample",
            Self::Mode => "mode",
        }
    }
}

/// How models are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OpenLoopSettings {
    /// Trajectories a task.
    pub trajectories: usize,
    /// Steps that are seen.
    pub context: usize,
    /// Steps that are imagined after them.
    pub imagined: usize,
    /// How latents are chosen.
    pub latents: Latents,
    /// Seed of trajectories, draws and intervals.
    pub seed: u64,
    /// Films a task and model.
    pub films: usize,
    /// Which stretches of episodes.
    #[serde(default = "Windows::of_older_files")]
    pub windows: Windows,
    /// What is done in place of the recorded actions to see what depends on them; none in files from before it was measured.
    pub other_actions: Option<OtherActions>,
}

impl Default for OpenLoopSettings {
    /// Sizes are the paper's (Fig. 4).
    fn default() -> Self {
        Self {
            trajectories: 100,
            context: 10,
            imagined: 54,
            latents: Latents::Sample,
            seed: 0,
            films: 2,
            windows: Windows::Moving,
            other_actions: Some(OtherActions::Still),
        }
    }
}

/// Which stretches of episodes are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Windows {
    /// Those that end before the step at which the task is first solved, and in which the robot moves at half of the imagined steps
    /// or more. Where success comes early they are shorter, but not below 15 imagined steps.
    Moving,
    /// All, also those in which the robot holds still or that go on after success.
    Anywhere,
}

impl Windows {
    /// Its name in files and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Moving => "moving",
            Self::Anywhere => "anywhere",
        }
    }

    /// What files say in which there is nothing about it.
    pub(super) const fn of_older_files() -> Self {
        Self::Anywhere
    }
}
