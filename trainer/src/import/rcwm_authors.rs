//! The RCWM of the paper's authors: names of its `agent_state_dict`.

use rcwm_models::settings::{ModelKind, ModelSettings, Preset};

use super::ImportError;
use super::names::Layers::{Convolutions, Dense, Mlp, Same};
use super::names::{Meaning, Piece, Rule, by_rules, original};
use super::pytorch::File;

const RULES: &[Rule] = &[
    ("_wm.encoder._cnn_share.layers.", "encoder.shared.", Convolutions),
    ("_wm.encoder._cnn1.layers.", "encoder.robot.", Convolutions),
    ("_wm.encoder._cnn2.layers.", "encoder.environment.", Convolutions),
    ("_wm.dynamics.robot_W", "robot.initial", Same),
    ("_wm.dynamics.env_W", "environment.initial", Same),
    ("_wm.dynamics._robot_inp_layers.", "robot.input.", Dense),
    ("_wm.dynamics._env_inp_layers.", "environment.input.", Dense),
    ("_wm.dynamics._robot_cell._layer.", "robot.cell.linear.", Same),
    ("_wm.dynamics._robot_cell._norm.", "robot.cell.norm.", Same),
    ("_wm.dynamics._env_cell._layer.", "environment.cell.linear.", Same),
    ("_wm.dynamics._env_cell._norm.", "environment.cell.norm.", Same),
    ("_wm.dynamics._robot_img_out_layers.", "robot.prior.dense.", Dense),
    ("_wm.dynamics._env_img_out_layers.", "environment.prior.dense.", Dense),
    ("_wm.dynamics._robot_obs_out_layers.", "robot.posterior.dense.", Dense),
    ("_wm.dynamics._env_obs_out_layers.", "environment.posterior.dense.", Dense),
    ("_wm.dynamics._robot_ims_stat_layer.", "robot.prior.logits.", Same),
    ("_wm.dynamics._env_ims_stat_layer.", "environment.prior.logits.", Same),
    ("_wm.dynamics._robot_obs_stat_layer.", "robot.posterior.logits.", Same),
    ("_wm.dynamics._env_obs_stat_layer.", "environment.posterior.logits.", Same),
    ("_wm.dynamics.robot_deter_layer.0.", "interaction.deter.", Same),
    ("_wm.dynamics.robot_env_atten.fc_q.", "interaction.query.", Same),
    ("_wm.dynamics.robot_env_atten.fc_k.", "interaction.key.", Same),
    ("_wm.dynamics.robot_env_atten.fc_v.", "interaction.value.", Same),
    ("_wm.dynamics.robot_env_atten.fc_o.", "interaction.output.", Same),
    ("_wm.dynamics.robot_env_atten.layernorm.", "interaction.norm.", Same),
    ("_wm.heads.decoder._robot_decoder._linear_layer.", "decoder.robot.linear.", Same),
    ("_wm.heads.decoder._robot_decoder.layers.", "decoder.robot.", Convolutions),
    ("_wm.heads.decoder._env_decoder._linear_layer.", "decoder.environment.linear.", Same),
    ("_wm.heads.decoder._env_decoder.layers.", "decoder.environment.", Convolutions),
    ("_wm.heads.reward.layers.", "heads.reward.", Mlp),
    ("_wm.heads.reward.mean_layer.", "heads.reward.out.", Same),
    ("_wm.heads.cont.layers.", "heads.continue.", Mlp),
    ("_wm.heads.cont.mean_layer.", "heads.continue.out.", Same),
    ("_task_behavior.actor._pre_layers.", "actor.", Mlp),
    ("_task_behavior.actor._dist_layer.", "actor.out.", Same),
    ("_task_behavior.value.layers.", "critic.", Mlp),
    ("_task_behavior.value.mean_layer.", "critic.out.", Same),
    ("_task_behavior._slow_value.layers.", "slow_critic.", Mlp),
    ("_task_behavior._slow_value.mean_layer.", "slow_critic.out.", Same),
];

pub(super) fn meaning(name: &str) -> Meaning {
    if let Some(original) = original(name) {
        return Meaning::CopyOf(original);
    }
    // A head that their losses never use.
    if name.starts_with("_wm.robot_predictor.") {
        return Meaning::NotOfTheModel;
    }
    by_rules(name, RULES).map_or(Meaning::Unknown, |ours| Meaning::Parameter(ours, Piece::Whole))
}

pub(super) fn sizes(file: &File) -> Result<ModelSettings, ImportError> {
    let [classes, _] = file.sides("_wm.dynamics.robot_env_atten.fc_q.weight")?;
    let [latent, hidden] = file.sides("_wm.dynamics._robot_ims_stat_layer.weight")?;
    let [_, deter] = file.sides("_wm.dynamics.robot_W")?;
    let [_, input] = file.sides("_wm.dynamics._robot_inp_layers.0.weight")?;
    let [cnn_depth, ..] = file.sides::<4>("_wm.encoder._cnn_share.layers.0.weight")?;
    let [bins, units] = file.sides("_wm.heads.reward.mean_layer.weight")?;
    Ok(ModelSettings {
        kind: ModelKind::Rcwm,
        cnn_depth,
        categoricals: latent / classes.max(1),
        classes,
        deter,
        hidden,
        units,
        bins,
        action: input.saturating_sub(latent),
        ..ModelSettings::preset(Preset::Paper, ModelKind::Rcwm)
    })
}
