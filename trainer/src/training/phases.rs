use rcwm_models::IMAGE_SIDE;
use rcwm_models::episode::STEPS_MAX;
use rcwm_models::settings::{Preset, SettingsError};
use serde::{Deserialize, Serialize};

use crate::cloning::{CloningSettings, Ramp};
use crate::replay::Starts;
use crate::simulators::{DISTURBANCES, LAYOUTS};

/// When and on what a run that acts is judged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationSettings {
    /// Steps of the policy between two evaluations, the first before any; 0 evaluates never.
    pub every_steps: u64,
    /// Episodes of each.
    pub episodes: u64,
    /// The set of layouts: one of [`LAYOUTS`]. `choosing` unless the curve is to be reported and nothing is chosen by it.
    pub layouts: String,
}

impl Default for EvaluationSettings {
    fn default() -> Self {
        Self { every_steps: 0, episodes: 20, layouts: "choosing".to_owned() }
    }
}

impl EvaluationSettings {
    /// What is wrong, if anything.
    pub(super) fn invalid(&self) -> Option<String> {
        if self.episodes == 0 {
            return Some("finetune.evaluation.episodes = 0, expected at least 1".to_owned());
        }
        if !LAYOUTS.contains(&self.layouts.as_str()) {
            let (found, expected) = (&self.layouts, LAYOUTS.join(", "));
            return Some(format!("finetune.evaluation.layouts = {found:?}, expected one of {expected}"));
        }
        None
    }

    /// How many evaluations are due after so many steps.
    pub(super) fn due(&self, policy_steps: u64) -> u64 {
        policy_steps.checked_div(self.every_steps).map_or(0, |whole| whole + 1)
    }
}

/// What a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// The world model, on recorded episodes of several tasks.
    #[default]
    Pretrain,
    /// A new task from demonstrations alone.
    Fewshot,
    /// A new task, acting and learning, from a pre-trained model.
    Finetune,
    /// A task from scratch, acting and learning.
    Train,
}

impl Phase {
    /// The command line's name of it.
    #[must_use]
    pub const fn verb(self) -> &'static str {
        match self {
            Self::Pretrain => "pretrain",
            Self::Fewshot => "fewshot",
            Self::Finetune => "finetune",
            Self::Train => "train",
        }
    }
}

/// Learning a new task from demonstrations alone: first the environment's side, then the whole world model, then the
/// actor. The vanilla baseline has no environment's side: both of its first stages train all of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FewshotSettings {
    /// Successful episodes that are used, in the order of their names.
    pub demonstrations: usize,
    /// Steps of a demonstration that are used after its first success: what comes long after it is holding still, which teaches nothing
    /// and would be most of what is learned from.
    pub steps_after_success: usize,
    /// Demonstrations of these that are not learned from: the cloning loss on them is told with every checkpoint.
    pub held_out: usize,
    /// Updates of the environment's side alone.
    pub environment_updates: u64,
    /// Updates of the whole world model.
    pub world_updates: u64,
    pub actor_updates: u64,
    /// Factor of the cloning loss while the world model learns: above 0 the actor learns from the first update on, and its gradient goes
    /// on into posteriors and encoders. 0 is what the authors do.
    pub imitation_scale: f64,
    /// Where the sequences begin that the world model learns from.
    pub starts: Starts,
    /// Pixels by which pictures are shifted at most, a whole sequence alike: what is learned should not depend on where the camera hangs.
    pub shift: usize,
    /// Whether the world model goes on learning while the actor does; frozen, its states are computed once.
    pub world_goes_on: bool,
    /// The actor's stage.
    pub cloning: CloningSettings,
}

impl Default for FewshotSettings {
    fn default() -> Self {
        Self {
            demonstrations: 50,
            steps_after_success: STEPS_MAX,
            held_out: 0,
            environment_updates: 2000,
            world_updates: 2000,
            actor_updates: 20_000,
            imitation_scale: 0.0,
            starts: Starts::Anywhere,
            shift: 0,
            world_goes_on: false,
            cloning: CloningSettings::default(),
        }
    }
}

impl FewshotSettings {
    pub(super) fn preset(preset: Preset) -> Self {
        let paper = Self::default();
        // Imagination costs more than all the rest of an update: two cores clone only.
        let off = Ramp { first: 0.0, last: 0.0, updates: 0 };
        match preset {
            Preset::Debug => Self {
                environment_updates: 4,
                world_updates: 4,
                actor_updates: 12,
                cloning: CloningSettings {
                    rows: 16,
                    draws: 2,
                    imagination_rows: 4,
                    weight: Ramp { updates: 8, ..paper.cloning.weight },
                    imagination_weight: Ramp { updates: 8, ..paper.cloning.imagination_weight },
                    ..paper.cloning
                },
                ..paper
            },
            Preset::Small => Self {
                steps_after_success: 30,
                environment_updates: 100,
                world_updates: 2200,
                actor_updates: 4000,
                imitation_scale: 100.0,
                starts: Starts::Episodes,
                cloning: CloningSettings {
                    imagination_rows: 64,
                    weight: Ramp { updates: 4000, ..paper.cloning.weight },
                    imagination_weight: off,
                    ..paper.cloning
                },
                ..paper
            },
            Preset::Paper => paper,
        }
    }

    /// Updates of all stages.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.environment_updates + self.world_updates + self.actor_updates
    }

    pub(super) fn validate(&self) -> Result<(), SettingsError> {
        if self.demonstrations == 0 {
            return Err(SettingsError::Invalid("fewshot.demonstrations = 0, expected at least 1".into()));
        }
        if !(self.imitation_scale.is_finite() && self.imitation_scale >= 0.0) {
            return Err(SettingsError::Invalid(format!(
                "fewshot.imitation_scale = {}, expected a factor of at least 0",
                self.imitation_scale
            )));
        }
        if self.shift >= IMAGE_SIDE {
            return Err(SettingsError::Invalid(format!(
                "fewshot.shift = {}, expected fewer pixels than a picture has: {IMAGE_SIDE}",
                self.shift
            )));
        }
        self.cloning.validate()
    }
}

/// Acting and learning on one task. A **step** is one decision of the policy: with the action repeat of 2 it is
/// two steps of the environment as the paper's figures count them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FinetuneSettings {
    /// Successful episodes of the scripted expert in the replay before the policy acts.
    pub expert_episodes: u64,
    /// Random steps in the replay before the policy acts.
    pub random_steps: u64,
    /// Updates of the world model alone before the policy acts.
    pub warm_up_updates: u64,
    /// Steps that the policy makes in all.
    pub steps: u64,
    /// Steps that are replayed for every step that is made.
    pub train_ratio: f64,
    /// Updates after which the policy acts with new weights, where updates are made on a GPU: acting stays on the CPU, and bringing
    /// the weights there takes about as long as an update. On the CPU it always acts with the newest.
    pub acting_weights_every: u64,
    /// Simulators at a time.
    pub simulators: usize,
    /// Decisions in an episode.
    pub episode_steps: u32,
    /// Whether the simulators render robot masks and the world model learns from them.
    pub masks: bool,
    /// Visual disturbance: one of [`DISTURBANCES`].
    pub disturb: String,
    /// Separate episodes that it is judged by while it learns.
    pub evaluation: EvaluationSettings,
    /// The newest episodes of which the success rate is told; that of the best checkpoint is the highest.
    pub success_episodes: usize,
}

impl Default for FinetuneSettings {
    /// The paper's (Table 2): 1 M steps of the environment are 500 K decisions.
    fn default() -> Self {
        Self {
            expert_episodes: 20,
            random_steps: 2500,
            warm_up_updates: 500,
            steps: 500_000,
            train_ratio: 512.0,
            acting_weights_every: 8,
            simulators: 2,
            episode_steps: 250,
            masks: false,
            disturb: "none".to_owned(),
            evaluation: EvaluationSettings::default(),
            success_episodes: 20,
        }
    }
}

impl FinetuneSettings {
    pub(super) fn preset(preset: Preset) -> Self {
        let paper = Self::default();
        match preset {
            Preset::Debug => Self {
                expert_episodes: 1,
                random_steps: 30,
                warm_up_updates: 4,
                steps: 200,
                train_ratio: 4.0,
                episode_steps: 100,
                ..paper
            },
            // On two cores an update takes about a second: at 512 the simulators would stand still.
            Preset::Small => Self { warm_up_updates: 300, steps: 20_000, train_ratio: 64.0, ..paper },
            Preset::Paper => paper,
        }
    }

    /// Updates that are due after so many steps of the policy, for batches of so many replayed steps.
    #[must_use]
    pub fn updates_due(&self, steps: u64, batch_steps: usize) -> u64 {
        self.warm_up_updates + (steps as f64 * self.train_ratio / batch_steps.max(1) as f64).floor() as u64
    }

    pub(super) fn validate(&self) -> Result<(), SettingsError> {
        let invalid = |text: String| Err(SettingsError::Invalid(text));
        if self.acting_weights_every == 0 {
            return invalid("finetune.acting_weights_every = 0, expected at least 1".to_owned());
        }
        if !self.train_ratio.is_finite() || self.train_ratio < 0.0 {
            return invalid(format!("finetune.train_ratio = {}, expected at least 0", self.train_ratio));
        }
        if self.success_episodes == 0 {
            return invalid("finetune.success_episodes = 0, expected at least 1".into());
        }
        if !(1..=250).contains(&self.episode_steps) {
            return invalid(format!("finetune.episode_steps = {}, expected 1 to 250", self.episode_steps));
        }
        if self.expert_episodes == 0 && self.random_steps == 0 {
            return invalid(
                "finetune.expert_episodes and finetune.random_steps are both 0, but there must be something to replay".into(),
            );
        }
        if let Some(text) = self.evaluation.invalid() {
            return invalid(text);
        }
        if !DISTURBANCES.contains(&self.disturb.as_str()) {
            return invalid(format!(
                "finetune.disturb = {:?}, expected one of {}",
                self.disturb,
                DISTURBANCES.join(", ")
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_steps_are_replayed_as_the_ratio_says() {
        let settings =
            FinetuneSettings { train_ratio: 512.0, warm_up_updates: 500, ..FinetuneSettings::default() };
        let due = |steps| settings.updates_due(steps, 16 * 64);
        assert_eq!([0, 1, 2, 3, 1000].map(due), [500, 500, 501, 501, 1000]);
        let settings = FinetuneSettings { train_ratio: 0.0, ..settings };
        assert_eq!(settings.updates_due(1000, 1024), 500, "nothing is learned after the warm-up");
    }
}
