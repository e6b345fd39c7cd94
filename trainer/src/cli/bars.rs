//! What the verbs that learn a task have in common.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::settings::{self, Preset};
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::training::{Phase, TrainingSettings};

pub use rcwm_models::progress::{Bar, say};

use super::PresetName;

/// Settings with those that `--set` changes. What the phase has no use for is refused, and so is what an option of its own says.
pub fn changed(settings: &TrainingSettings, overrides: &[String]) -> Result<TrainingSettings> {
    let phase = settings.phase;
    for change in overrides {
        let key = change.split('=').next().unwrap_or_default().trim();
        let first = key.split('.').next().unwrap_or_default();
        let verb = phase.verb();
        match first {
            "phase" | "preset" => bail!("--set {key}: it says what the run is, and cannot be changed"),
            "data" | "from" | "task" | "masks" => bail!("--set {key}: has an option of its own, --{key}"),
            _ => {}
        }
        let acts = matches!(phase, Phase::Finetune | Phase::Train);
        let unused = match first {
            "pretrain" => phase != Phase::Pretrain,
            "fewshot" => phase != Phase::Fewshot,
            "finetune" => !acts,
            "reset" => matches!(phase, Phase::Pretrain | Phase::Train),
            "behaviour" => phase == Phase::Pretrain,
            "average_decay" => acts,
            _ => false,
        };
        if unused {
            bail!("--set {key}: {verb} has no use for it; leave it out");
        }
    }
    Ok(settings::with_overrides(settings, overrides)?)
}

/// What is to be told of the folders of episodes.
pub fn tell(notes: &[String]) {
    for note in notes {
        rcwm_models::errln!("{note}");
    }
}

/// A bar of updates with an estimated end; the message is a line below it.
pub fn updates(all: u64, done: u64) -> ProgressBar {
    let bar = ProgressBar::new(all);
    if let Ok(style) = ProgressStyle::with_template("{wide_bar} {pos}/{len} ETA {eta}\n{msg}") {
        bar.set_style(style);
    }
    bar.set_position(done);
    bar.reset_eta();
    bar
}

/// A run may be resumed from another folder.
pub fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).with_context(|| format!("{}", path.display()))
}

/// Settings of a phase for a model of the checkpoint's sizes, with the amounts of `preset`, else those of the checkpoint's own.
pub fn settings_from(source: &Checkpoint, phase: Phase, preset: Option<PresetName>) -> TrainingSettings {
    let own = match source.settings.preset.as_str() {
        "debug" => Preset::Debug,
        "paper" => Preset::Paper,
        _ => Preset::Small,
    };
    let model = &source.settings.model;
    let preset = preset.map_or(own, PresetName::preset);
    let mut settings = TrainingSettings::of_phase(phase, preset, model.kind);
    settings.model = model.clone();
    settings.preset.clone_from(&source.settings.preset);
    settings
}

#[cfg(test)]
mod tests {
    use super::*;
    use rcwm_models::settings::ModelKind;

    #[test]
    fn what_a_phase_has_no_use_for_is_refused_and_the_rest_is_taken() {
        let settings = |phase| TrainingSettings::of_phase(phase, Preset::Debug, ModelKind::Rcwm);
        let change = |phase, change: &str| changed(&settings(phase), &[change.to_owned()]);
        let phases = [Phase::Pretrain, Phase::Fewshot, Phase::Finetune, Phase::Train];
        for phase in phases {
            assert_eq!(change(phase, "replay.batch=3").unwrap().replay.batch, 3);
            assert_eq!(change(phase, "seed=4").unwrap().seed, 4);
            for refused in ["phase=train", "task=reach", "data=elsewhere", "masks=there", "no.such=1"] {
                assert!(change(phase, refused).is_err(), "{phase:?}: {refused}");
            }
        }
        let taken =
            |key: &str| -> Vec<bool> { phases.iter().map(|phase| change(*phase, key).is_ok()).collect() };
        assert_eq!(taken("pretrain.updates=9"), [true, false, false, false]);
        assert_eq!(taken("fewshot.actor_updates=9"), [false, true, false, false]);
        assert_eq!(taken("finetune.steps=9"), [false, false, true, true]);
        assert_eq!(taken("average_decay=0.5"), [true, true, false, false]);
    }
}
