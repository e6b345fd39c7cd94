use candle_core::Device;
use rcwm_models::settings::{ModelKind, ModelSettings};
use serde::{Deserialize, Serialize};

use crate::checkpoint::Checkpoint;
use crate::learning::{Side, side_of};
use crate::model::agent;
use crate::model::parameters::{ParameterError, ParameterSpec, Parameters};

/// What of a pre-trained world model starts anew on a new task.
///
/// | name | drawn anew |
/// | --- | --- |
/// | `none` | nothing |
/// | `heads` | reward and continuation |
/// | `heads+environment` | those and the environment's dynamics: cell, prior, posterior, initial state |
/// | `all-but-robot` | those and the interaction (the paper's choice) |
///
/// Encoders, decoders and the robot's dynamics are kept by all of them. The vanilla baseline has no such parts: it keeps everything.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Reset {
    /// Nothing
    None,
    /// Reward and continuation
    Heads,
    /// Those and the environment's dynamics
    #[serde(rename = "heads+environment")]
    #[value(name = "heads+environment")]
    HeadsEnvironment,
    /// Those and the interaction: what the paper does
    #[default]
    AllButRobot,
}

/// What a model that learns a new task keeps of the one it starts from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResetSettings {
    /// What of the world model is drawn anew.
    pub parts: Reset,
    /// Whether actor and critic are kept: only sensible from a model that has learned to act.
    pub keep_behaviour: bool,
}

impl ResetSettings {
    /// Whether the parameter of this name is drawn anew for a model of this kind.
    #[must_use]
    pub fn reinitialises(&self, kind: ModelKind, name: &str) -> bool {
        match side_of(name) {
            Side::Actor | Side::Critic | Side::SlowCritic => !self.keep_behaviour,
            Side::Robot | Side::Environment => kind == ModelKind::Rcwm && self.parts.holds(name),
        }
    }
}

impl Reset {
    fn holds(self, name: &str) -> bool {
        match name.split('.').next().unwrap_or_default() {
            "heads" => self != Self::None,
            "environment" => matches!(self, Self::HeadsEnvironment | Self::AllButRobot),
            "interaction" => self == Self::AllButRobot,
            _ => false,
        }
    }
}

/// The parameters a new task starts from: those of `source`, but for what the settings draw anew from the initialiser under `seed`.
pub fn start_from(
    source: &Checkpoint,
    settings: &ResetSettings,
    seed: u64,
    device: &Device,
) -> Result<Parameters, ParameterError> {
    let model: &ModelSettings = &source.settings.model;
    let specs = agent::specs(model)?;
    let anew: Vec<ParameterSpec> =
        specs.iter().filter(|spec| settings.reinitialises(model.kind, &spec.name)).cloned().collect();
    let fresh = Parameters::initialise(&anew, seed, device)?;
    let kept = source.parameters.iter().map(|(name, var)| {
        let value = fresh.get(name).unwrap_or(var);
        Ok((name.to_owned(), value.as_tensor().detach()))
    });
    Parameters::from_tensors(&specs, kept.collect::<Result<_, ParameterError>>()?, device)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_table_on_the_command_line_and_in_toml() {
        use clap::ValueEnum;
        for (reset, name) in [
            (Reset::None, "none"),
            (Reset::Heads, "heads"),
            (Reset::HeadsEnvironment, "heads+environment"),
            (Reset::AllButRobot, "all-but-robot"),
        ] {
            assert_eq!(Reset::from_str(name, false), Ok(reset));
            let settings = ResetSettings { parts: reset, keep_behaviour: false };
            assert!(toml::to_string(&settings).unwrap().contains(&format!("parts = \"{name}\"")));
        }
    }

    #[test]
    fn encoders_decoders_and_the_robot_are_always_kept() {
        let settings = ResetSettings::default();
        for name in [
            "encoder.shared.0.conv.weight",
            "encoder.environment.0.conv.weight",
            "decoder.environment.linear.weight",
            "decoder.robot.linear.weight",
            "robot.cell.linear.weight",
        ] {
            assert!(!settings.reinitialises(ModelKind::Rcwm, name), "{name}");
        }
    }
}
