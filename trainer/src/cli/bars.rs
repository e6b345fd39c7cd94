//! What the verbs that learn a task have in common.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::settings::Preset;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::training::{Phase, TrainingSettings};

use super::PresetName;

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
