use serde::{Deserialize, Serialize};

use super::AdamSettings;

/// How the world model learns (paper, Table 2).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldSettings {
    /// Factor of the image loss.
    pub image_scale: f64,
    /// Factor of the robot mask's loss, where masks are used.
    pub mask_scale: f64,
    /// Factor of the measured state's loss, where the model looks at it.
    pub state_scale: f64,
    /// Factor of the reward's cross-entropy.
    pub reward_scale: f64,
    /// Factor of the continuation's cross-entropy.
    pub continue_scale: f64,
    /// Factor of KL[sg(q) || p], which trains the prior.
    pub dynamics_scale: f64,
    /// Factor of KL[q || sg(p)], which trains the posterior.
    pub representation_scale: f64,
    /// Of so many steps one is decoded and compared with its image, by turns: decoding is most of an update's work. 1 decodes all.
    #[serde(alias = "paint_every")]
    pub decode_every: usize,
    /// KL below which nothing is learned from it, in nats per branch and step.
    pub free_nats: f64,
    /// The optimiser.
    pub adam: AdamSettings,
    /// Learning rate of the environment's side where it differs from the robot's; 0 stands for `adam.learning_rate`.
    pub environment_learning_rate: f64,
}

impl Default for WorldSettings {
    fn default() -> Self {
        Self {
            image_scale: 1.0,
            mask_scale: 1.0,
            state_scale: 10.0,
            reward_scale: 100.0,
            continue_scale: 1.0,
            dynamics_scale: 0.5,
            representation_scale: 0.1,
            decode_every: 1,
            free_nats: 1.0,
            adam: AdamSettings {
                learning_rate: 1e-4,
                eps: 1e-8,
                clip_norm: 1000.0,
                ..AdamSettings::default()
            },
            environment_learning_rate: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_of_the_settings_is_enough_and_an_unknown_one_is_refused() {
        let found: WorldSettings = toml::from_str("reward_scale = 1.0").unwrap();
        assert_eq!(found, WorldSettings { reward_scale: 1.0, ..WorldSettings::default() });
        let former: WorldSettings = toml::from_str("paint_every = 4").unwrap();
        assert_eq!(former, WorldSettings { decode_every: 4, ..WorldSettings::default() });
        assert!(toml::from_str::<WorldSettings>("reward_scael = 1.0").is_err());
        assert!(toml::from_str::<WorldSettings>("[adam]\nlr = 1.0").is_err());
    }
}
