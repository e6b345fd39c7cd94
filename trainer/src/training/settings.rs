use std::path::PathBuf;

use rcwm_models::settings::{ModelKind, ModelSettings, Preset, SettingsError};
use serde::{Deserialize, Serialize};

use super::{FewshotSettings, FinetuneSettings, Phase, ResetSettings};
use crate::behaviour::BehaviourSettings;
use crate::learning::{LookSettings, WorldSettings};

/// Films of the open loop, one a task, with every checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilmSettings {
    /// Steps that are seen before the model imagines.
    pub context: usize,
    /// Steps in all; 0 makes no films.
    pub length: usize,
    /// Steps from one picture of the strip to the next; the film shows every step.
    pub every: usize,
}

impl Default for FilmSettings {
    fn default() -> Self {
        Self { context: 10, length: 64, every: 4 }
    }
}

/// Everything that can be chosen for a run. The resolved settings are written into its folder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSettings {
    /// What the run is.
    #[serde(default)]
    pub phase: Phase,
    /// Sizes the run started from: `debug`, `small`, `paper`, or `custom` where the model was changed.
    pub preset: String,
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Folder of the episodes, `task/*.npz`.
    pub data: PathBuf,
    /// Folder of the checkpoint that the weights came from; empty for a run from scratch.
    #[serde(default)]
    pub from: PathBuf,
    /// The task that is learned; empty for all that the data has.
    #[serde(default)]
    pub task: String,
    /// Folder of masks as pictures, `task/episode/*.png`; empty where the episodes' own masks are used.
    #[serde(default)]
    pub masks: PathBuf,
    /// Updates between two lines of metrics.
    #[serde(default = "metrics_every")]
    pub metrics_every: u64,
    /// Updates between two checkpoints.
    #[serde(default = "checkpoint_every")]
    pub checkpoint_every: u64,
    /// What the running average of the weights keeps of itself with every update: checkpoints hold the average, which small batches
    /// shake less than the weights. 0 averages nothing, as the
    /// authors; runs that act keep the weights that acted, whatever this is.
    #[serde(default)]
    pub average_decay: f64,
    /// Sizes of the model.
    pub model: ModelSettings,
    /// Learning of the world model.
    #[serde(default)]
    pub world: WorldSettings,
    /// Learning of actor and critic.
    #[serde(default)]
    pub behaviour: BehaviourSettings,
    /// Experience and batches.
    #[serde(default)]
    pub replay: ReplaySettings,
    /// Film strips.
    #[serde(default)]
    pub film: FilmSettings,
    /// The pre-training phase.
    #[serde(default)]
    pub pretrain: PretrainSettings,
    /// What a new task starts from.
    #[serde(default)]
    pub reset: ResetSettings,
    /// Learning from demonstrations alone.
    #[serde(default)]
    pub fewshot: FewshotSettings,
    /// Acting and learning.
    #[serde(default)]
    pub finetune: FinetuneSettings,
}

fn metrics_every() -> u64 {
    20
}

fn checkpoint_every() -> u64 {
    500
}

/// Experience and the batches drawn from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplaySettings {
    /// Steps held; the oldest episodes leave. A step takes 12 KiB, with a mask 16 KiB.
    pub capacity_steps: usize,
    /// B: sequences in a batch.
    pub batch: usize,
    /// T: steps of a sequence.
    pub length: usize,
    /// Batches drawn ahead of their use.
    pub prefetch: usize,
    /// Episodes of each task that are not trained on: the best checkpoint is chosen by them, and films are of them.
    /// Never more than half of a task's; 0 holds none out.
    pub held_out_episodes: usize,
    /// Batches of them that a checkpoint is judged by, the same for every checkpoint.
    pub held_out_batches: usize,
    /// How the encoders see what is learned from.
    pub look: LookSettings,
}

impl Default for ReplaySettings {
    /// The paper's (Table 2), for pre-training.
    fn default() -> Self {
        Self {
            capacity_steps: 2_000_000,
            batch: 16,
            length: 64,
            prefetch: 4,
            held_out_episodes: 2,
            held_out_batches: 4,
            look: LookSettings::default(),
        }
    }
}

/// Pre-training: `warm_up_updates` on the masked trajectories with the mask loss, then mask-free ones on everything.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PretrainSettings {
    /// Updates with masks.
    pub warm_up_updates: u64,
    /// Updates in all, warm-up included.
    pub updates: u64,
}

impl Default for PretrainSettings {
    /// The paper's (Table 2).
    fn default() -> Self {
        Self { warm_up_updates: 1000, updates: 500_000 }
    }
}

/// The paper's, but for `small`, which is to learn in an hour what the paper's preset takes days for: a higher learning rate, and rewards
/// that do not drown the few other numbers there are to learn from (tried in `docs/history/lab.md`).
fn world_settings(preset: Preset) -> WorldSettings {
    let mut world = WorldSettings::default();
    if preset == Preset::Small {
        world.adam.learning_rate = 3e-4;
        world.reward_scale = 1.0;
    }
    world
}

impl TrainingSettings {
    /// A run of a preset on the episodes in `data`.
    #[must_use]
    pub fn preset(preset: Preset, kind: ModelKind, data: PathBuf) -> Self {
        let paper = ReplaySettings::default();
        let (name, average_decay, replay, pretrain) = match preset {
            Preset::Debug => (
                "debug",
                0.5,
                ReplaySettings { batch: 2, length: 6, ..paper },
                PretrainSettings { warm_up_updates: 10, updates: 40 },
            ),
            Preset::Small => (
                "small",
                0.998,
                ReplaySettings { batch: 8, length: 32, ..paper },
                PretrainSettings { warm_up_updates: 500, updates: 20_000 },
            ),
            Preset::Paper => ("paper", 0.0, paper, PretrainSettings::default()),
        };
        Self {
            phase: Phase::Pretrain,
            preset: name.to_owned(),
            seed: 0,
            data,
            from: PathBuf::new(),
            task: String::new(),
            masks: PathBuf::new(),
            metrics_every: metrics_every(),
            checkpoint_every: checkpoint_every(),
            average_decay,
            model: ModelSettings::preset(preset, kind),
            world: world_settings(preset),
            behaviour: BehaviourSettings::default(),
            replay,
            film: FilmSettings::default(),
            pretrain,
            reset: ResetSettings::default(),
            fewshot: FewshotSettings::preset(preset),
            finetune: FinetuneSettings::preset(preset),
        }
    }

    /// A run of another phase, with what the preset has for it: few-shot learning of `small` goes through whole demonstrations, decodes few
    /// of their steps, and lets the reward say what matters in the scene (tried in `docs/history/lab.md`).
    #[must_use]
    pub fn of_phase(phase: Phase, preset: Preset, kind: ModelKind) -> Self {
        let mut settings = Self { phase, ..Self::preset(preset, kind, PathBuf::new()) };
        if (phase, preset) == (Phase::Fewshot, Preset::Small) {
            settings.replay = ReplaySettings { batch: 4, length: 64, ..settings.replay };
            settings.world.decode_every = 4;
            settings.world.reward_scale = 10.0;
        }
        settings
    }

    /// Checks what TOML's types do not.
    ///
    /// # Errors
    /// [`SettingsError::Invalid`] names the setting, what was found and what is accepted.
    pub fn validate(&self) -> Result<(), SettingsError> {
        self.model.validate()?;
        let replay = &self.replay;
        for (name, value, least) in [
            ("replay.batch", replay.batch, 1),
            ("replay.length", replay.length, 2),
            ("replay.prefetch", replay.prefetch, 1),
            ("replay.held_out_batches", replay.held_out_batches, 1),
            ("replay.capacity_steps", replay.capacity_steps, replay.length),
            ("behaviour.horizon.length", self.behaviour.horizon.length, 2),
        ] {
            if value < least {
                return Err(SettingsError::Invalid(format!("{name} = {value}, expected at least {least}")));
            }
        }
        if let Some(text) = replay.look.invalid() {
            return Err(SettingsError::Invalid(text));
        }
        if !(1..=replay.length).contains(&self.world.decode_every) {
            return Err(SettingsError::Invalid(format!(
                "world.decode_every = {}, expected 1 to replay.length = {}",
                self.world.decode_every, replay.length
            )));
        }
        if !(0.0..1.0).contains(&self.average_decay) {
            let found = self.average_decay;
            return Err(SettingsError::Invalid(format!(
                "average_decay = {found}, expected 0 <= average_decay < 1"
            )));
        }
        for (name, every) in
            [("metrics_every", self.metrics_every), ("checkpoint_every", self.checkpoint_every)]
        {
            if every == 0 {
                return Err(SettingsError::Invalid(format!("{name} = 0, expected at least 1")));
            }
        }
        for (name, adam) in [
            ("world.adam", &self.world.adam),
            ("behaviour.actor", &self.behaviour.actor),
            ("behaviour.critic", &self.behaviour.critic),
            ("fewshot.cloning.actor", &self.fewshot.cloning.actor),
        ] {
            let positive = |x: f64| x.is_finite() && x > 0.0;
            let decays = |x: f64| (0.0..1.0).contains(&x);
            let valid = [adam.learning_rate, adam.eps, adam.clip_norm].into_iter().all(positive);
            if !valid || !decays(adam.beta1) || !decays(adam.beta2) {
                let expected = "positive learning_rate, eps and clip_norm, beta1 and beta2 in [0, 1)";
                return Err(SettingsError::Invalid(format!("{name}: found {adam:?}, expected {expected}")));
            }
        }
        self.fewshot.validate()?;
        self.finetune.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid_and_survive_toml() {
        for preset in [Preset::Debug, Preset::Small, Preset::Paper] {
            for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
                let settings = TrainingSettings::preset(preset, kind, "data".into());
                settings.validate().unwrap();
                let text = toml::to_string(&settings).unwrap();
                assert_eq!(toml::from_str::<TrainingSettings>(&text).unwrap(), settings);
            }
        }
    }

    #[test]
    fn the_paper_preset_has_the_papers_values() {
        let settings = TrainingSettings::preset(Preset::Paper, ModelKind::Rcwm, "data".into());
        assert_eq!((settings.replay.batch, settings.replay.length), (16, 64));
        assert_eq!((settings.pretrain.warm_up_updates, settings.pretrain.updates), (1000, 500_000));
        assert_eq!((settings.world.reward_scale, settings.world.adam.learning_rate), (100.0, 1e-4));
        let behaviour = &settings.behaviour;
        assert_eq!((behaviour.horizon.length, behaviour.actor.learning_rate), (15, 3e-5));
        assert_eq!((behaviour.entropy_scale, behaviour.horizon.discount), (3e-4, 0.997));
    }

    #[test]
    fn settings_that_cannot_work_are_refused_by_name() {
        let mut settings = TrainingSettings::preset(Preset::Debug, ModelKind::Rcwm, "data".into());
        settings.replay.length = 1;
        assert!(settings.validate().unwrap_err().to_string().contains("replay.length = 1"));
        settings.replay.length = 2;
        settings.world.adam.learning_rate = -1.0;
        assert!(settings.validate().unwrap_err().to_string().contains("world.adam"));
    }
}
