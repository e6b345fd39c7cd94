//! dreamerv3-torch: names of its `agent_state_dict`, those of older versions too.

use rcwm_models::settings::{ModelKind, ModelSettings, Preset};

use super::ImportError;
use super::names::Layers::{Convolutions, Dense, Same};
use super::names::{Meaning, Piece, Rule, by_rules, original};
use super::pytorch::File;

const RULES: &[Rule] = &[
    ("_wm.encoder._cnn.layers.", "encoder.", Convolutions),
    ("_wm.dynamics.W", "dynamics.initial", Same),
    ("_wm.dynamics._img_in_layers.", "dynamics.input.", Dense),
    ("_wm.dynamics._inp_layers.", "dynamics.input.", Dense),
    ("_wm.dynamics._cell.layers.GRU_linear.", "dynamics.cell.linear.", Same),
    ("_wm.dynamics._cell.layers.GRU_norm.", "dynamics.cell.norm.", Same),
    ("_wm.dynamics._cell._layer.", "dynamics.cell.linear.", Same),
    ("_wm.dynamics._cell._norm.", "dynamics.cell.norm.", Same),
    ("_wm.dynamics._img_out_layers.", "dynamics.prior.dense.", Dense),
    ("_wm.dynamics._obs_out_layers.", "dynamics.posterior.dense.", Dense),
    ("_wm.dynamics._imgs_stat_layer.", "dynamics.prior.logits.", Same),
    ("_wm.dynamics._ims_stat_layer.", "dynamics.prior.logits.", Same),
    ("_wm.dynamics._obs_stat_layer.", "dynamics.posterior.logits.", Same),
    ("_wm.heads.decoder._cnn._linear_layer.", "decoder.linear.", Same),
    ("_wm.heads.decoder._cnn.layers.", "decoder.", Convolutions),
    ("_wm.heads.reward.layers.Reward_linear0.", "heads.reward.0.linear.", Same),
    ("_wm.heads.reward.layers.Reward_norm0.", "heads.reward.0.norm.", Same),
    ("_wm.heads.reward.layers.Reward_linear1.", "heads.reward.1.linear.", Same),
    ("_wm.heads.reward.layers.Reward_norm1.", "heads.reward.1.norm.", Same),
    ("_wm.heads.reward.mean_layer.", "heads.reward.out.", Same),
    ("_wm.heads.cont.layers.Cont_linear0.", "heads.continue.0.linear.", Same),
    ("_wm.heads.cont.layers.Cont_norm0.", "heads.continue.0.norm.", Same),
    ("_wm.heads.cont.layers.Cont_linear1.", "heads.continue.1.linear.", Same),
    ("_wm.heads.cont.layers.Cont_norm1.", "heads.continue.1.norm.", Same),
    ("_wm.heads.cont.mean_layer.", "heads.continue.out.", Same),
    ("_task_behavior.actor.layers.Actor_linear0.", "actor.0.linear.", Same),
    ("_task_behavior.actor.layers.Actor_norm0.", "actor.0.norm.", Same),
    ("_task_behavior.actor.layers.Actor_linear1.", "actor.1.linear.", Same),
    ("_task_behavior.actor.layers.Actor_norm1.", "actor.1.norm.", Same),
    ("_task_behavior.actor.mean_layer.", "actor.out.", Same),
    ("_task_behavior.actor.std_layer.", "actor.out.", Same),
    ("_task_behavior.value.layers.Value_linear0.", "critic.0.linear.", Same),
    ("_task_behavior.value.layers.Value_norm0.", "critic.0.norm.", Same),
    ("_task_behavior.value.layers.Value_linear1.", "critic.1.linear.", Same),
    ("_task_behavior.value.layers.Value_norm1.", "critic.1.norm.", Same),
    ("_task_behavior.value.mean_layer.", "critic.out.", Same),
    ("_task_behavior._slow_value.layers.Value_linear0.", "slow_critic.0.linear.", Same),
    ("_task_behavior._slow_value.layers.Value_norm0.", "slow_critic.0.norm.", Same),
    ("_task_behavior._slow_value.layers.Value_linear1.", "slow_critic.1.linear.", Same),
    ("_task_behavior._slow_value.layers.Value_norm1.", "slow_critic.1.norm.", Same),
    ("_task_behavior._slow_value.mean_layer.", "slow_critic.out.", Same),
];

pub(super) fn meaning(name: &str) -> Meaning {
    if let Some(original) = original(name) {
        return Meaning::CopyOf(original);
    }
    // The returns' running range.
    if name == "_task_behavior.ema_vals" {
        return Meaning::NotOfTheModel;
    }
    let piece = if name.starts_with("_task_behavior.actor.mean_layer.") {
        Piece::Mean
    } else if name.starts_with("_task_behavior.actor.std_layer.") {
        Piece::Spread
    } else if name.starts_with("_wm.heads.decoder._cnn.layers.9.") {
        Piece::Picture
    } else {
        Piece::Whole
    };
    by_rules(name, RULES).map_or(Meaning::Unknown, |ours| Meaning::Parameter(ours, piece))
}

pub(super) fn sizes(file: &File, classes: usize) -> Result<ModelSettings, ImportError> {
    let [_, deter] = file.sides("_wm.dynamics.W")?;
    let [latent, hidden] = file.sides("_wm.dynamics._obs_stat_layer.weight")?;
    let input = ["_wm.dynamics._img_in_layers.0.weight", "_wm.dynamics._inp_layers.0.weight"]
        .into_iter()
        .find(|name| file.has(name))
        .unwrap_or("_wm.dynamics._img_in_layers.0.weight");
    let [_, input] = file.sides(input)?;
    let [cnn_depth, ..] = file.sides::<4>("_wm.encoder._cnn.layers.0.weight")?;
    let [bins, units] = file.sides("_wm.heads.reward.mean_layer.weight")?;
    if classes < 2 || !latent.is_multiple_of(classes) {
        return Err(ImportError::Shape {
            path: file.path().to_path_buf(),
            name: "_wm.dynamics._obs_stat_layer.weight".to_owned(),
            found: format!("of {latent} rows"),
            expected: format!("a multiple of {classes} classes, 2 or more (--classes)"),
        });
    }
    Ok(ModelSettings {
        kind: ModelKind::Vanilla,
        cnn_depth,
        categoricals: latent / classes,
        classes,
        deter,
        hidden,
        units,
        bins,
        action: input.saturating_sub(latent),
        ..ModelSettings::preset(Preset::Paper, ModelKind::Vanilla)
    })
}
