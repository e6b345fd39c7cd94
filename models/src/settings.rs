//! The sizes of a model: presets, TOML, and dotted overrides (`--set model.cnn_depth=16`).

use std::path::Path;

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::ACTION_LEN;

/// Which world model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ModelKind {
    /// Two branches, robot and environment, with the interaction model (the paper's).
    Rcwm,
    /// One branch: the DreamerV3 baseline with a mask predictor.
    Vanilla,
}

/// Named sets of sizes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Runs every code path in milliseconds.
    Debug,
    /// Trains on two CPU cores.
    Small,
    /// The paper's: 24.7 M parameters.
    Paper,
}

/// The sizes of a model. `n` categoricals of `m` classes, deterministic width `d`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSettings {
    /// RCWM or the vanilla baseline.
    pub kind: ModelKind,
    /// `c`: channels after the first convolution.
    pub cnn_depth: usize,
    /// `n`: categoricals of a branch's stochastic state z.
    pub categoricals: usize,
    /// `m`: classes of each categorical.
    pub classes: usize,
    /// `d`: width of the recurrent state h.
    pub deter: usize,
    /// Width of the dense layers inside the dynamics.
    pub hidden: usize,
    /// Width of the heads' dense layers (reward, continue, actor, critic).
    pub units: usize,
    /// Bins of the two-hot reward and value distributions, over symlog [-20, 20].
    pub bins: usize,
    /// Length of an action.
    pub action: usize,
    /// Share of the uniform distribution mixed into the class probabilities.
    pub unimix: f64,
}

impl ModelSettings {
    /// The sizes of a preset. Vanilla has one branch of twice the width and depth (paper, A.7).
    #[must_use]
    pub fn preset(preset: Preset, kind: ModelKind) -> Self {
        let (cnn_depth, latents, width, units) = match preset {
            Preset::Debug => (4, 8, 32, 32),
            Preset::Small => (8, 16, 128, 128),
            Preset::Paper => (32, 32, 256, 512),
        };
        let width = match kind {
            ModelKind::Rcwm => width,
            ModelKind::Vanilla => 2 * width,
        };
        Self {
            kind,
            cnn_depth,
            categoricals: latents,
            classes: latents,
            deter: width,
            hidden: width,
            units,
            bins: 255,
            action: ACTION_LEN,
            unimix: 0.01,
        }
    }

    /// `n * m`: width of a branch's flattened z.
    #[must_use]
    pub fn stoch_width(&self) -> usize {
        self.categoricals * self.classes
    }

    /// `n * m + d`: width of a branch's latent state s = [z, h].
    #[must_use]
    pub fn branch_width(&self) -> usize {
        self.stoch_width() + self.deter
    }

    /// Width of the whole latent state, all branches.
    #[must_use]
    pub fn state_width(&self) -> usize {
        match self.kind {
            ModelKind::Rcwm => 2 * self.branch_width(),
            ModelKind::Vanilla => self.branch_width(),
        }
    }

    /// `k = d / m`: rows the interaction model makes of the robot's h (A.2).
    #[must_use]
    pub fn interaction_rows(&self) -> usize {
        self.deter / self.classes
    }

    /// Checks that the sizes fit together and stay within what is ever sensible.
    ///
    /// # Errors
    /// [`SettingsError::Invalid`] names the setting, what was found and what is accepted.
    pub fn validate(&self) -> Result<(), SettingsError> {
        let in_range = |name: &'static str, value: usize, max: usize| {
            if value == 0 || value > max {
                return Err(SettingsError::Invalid(format!("{name} = {value}, expected 1 to {max}")));
            }
            Ok(())
        };
        in_range("cnn_depth", self.cnn_depth, 256)?;
        in_range("categoricals", self.categoricals, 256)?;
        in_range("classes", self.classes, 256)?;
        in_range("deter", self.deter, 8192)?;
        in_range("hidden", self.hidden, 8192)?;
        in_range("units", self.units, 8192)?;
        in_range("bins", self.bins, 4096)?;
        if self.action != ACTION_LEN {
            let found = self.action;
            return Err(SettingsError::Invalid(format!("action = {found}, the wire carries {ACTION_LEN}")));
        }
        if self.bins.is_multiple_of(2) {
            let found = self.bins;
            return Err(SettingsError::Invalid(format!(
                "bins = {found}, expected an odd number (one bin is 0)"
            )));
        }
        if self.kind == ModelKind::Rcwm && !self.deter.is_multiple_of(self.classes) {
            return Err(SettingsError::Invalid(format!(
                "deter = {} is not a multiple of classes = {}, which the interaction model needs (k = d / m)",
                self.deter, self.classes
            )));
        }
        if !(0.0..1.0).contains(&self.unimix) {
            return Err(SettingsError::Invalid(format!(
                "unimix = {}, expected 0 <= unimix < 1",
                self.unimix
            )));
        }
        Ok(())
    }
}

/// Why settings were refused.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The text is not TOML, or a key is unknown or of the wrong type.
    #[error("settings: {0}")]
    Toml(#[from] toml::de::Error),
    /// Settings could not be written as TOML.
    #[error("settings: {0}")]
    Serialize(#[from] toml::ser::Error),
    /// A value is out of range, or two do not fit together.
    #[error("settings: {0}")]
    Invalid(String),
    /// An override that is not `key=value`.
    #[error("--set {0:?}: expected key=value, for example model.cnn_depth=16")]
    OverrideForm(String),
    /// An override of a key that does not exist.
    #[error("--set {key}: no such setting{}", near.as_ref().map(|near| format!(", did you mean {near}?")).unwrap_or_default())]
    UnknownKey {
        /// The dotted key that was given.
        key: String,
        /// The nearest key there is.
        near: Option<String>,
    },
    /// The file could not be read.
    #[error(transparent)]
    File(#[from] crate::files::FileError),
}

/// Largest settings file accepted.
const SETTINGS_BYTES_MAX: u64 = 1 << 20;

/// Reads settings from a TOML file; unknown keys are refused.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, SettingsError> {
    let bytes = crate::files::read_capped(path, SETTINGS_BYTES_MAX)?;
    let text = String::from_utf8(bytes)
        .map_err(|_| SettingsError::Invalid(format!("{} is not UTF-8", path.display())))?;
    Ok(toml::from_str(&text)?)
}

/// Applies dotted overrides (`model.cnn_depth=16`) to settings. A key must exist already; the value is read as
/// TOML, and as a plain string where it is no TOML value (`task=reach`).
///
/// # Errors
/// [`SettingsError::OverrideForm`], [`SettingsError::UnknownKey`], or [`SettingsError::Toml`] for a wrong type.
pub fn with_overrides<T: Serialize + DeserializeOwned>(
    settings: &T,
    overrides: &[String],
) -> Result<T, SettingsError> {
    let mut root = toml::Table::try_from(settings)?;
    for text in overrides {
        let (key, value) = text.split_once('=').ok_or_else(|| SettingsError::OverrideForm(text.clone()))?;
        let key = key.trim();
        match slot_of(&mut root, key) {
            Some(slot) => *slot = parse_value(value.trim(), slot),
            None => {
                return Err(SettingsError::UnknownKey { key: key.to_owned(), near: nearest_key(&root, key) });
            }
        }
    }
    Ok(root.try_into()?)
}

fn slot_of<'a>(root: &'a mut toml::Table, key: &str) -> Option<&'a mut toml::Value> {
    match key.split_once('.') {
        None => root.get_mut(key),
        Some((first, rest)) => slot_of(root.get_mut(first)?.as_table_mut()?, rest),
    }
}

fn parse_value(text: &str, old: &toml::Value) -> toml::Value {
    let parsed =
        toml::from_str::<toml::Table>(&format!("value = {text}")).ok().and_then(|mut t| t.remove("value"));
    match (parsed, old) {
        // `lr=1` is meant as 1.0 where the setting is a float.
        (Some(toml::Value::Integer(integer)), toml::Value::Float(_)) => toml::Value::Float(integer as f64),
        (Some(value), _) => value,
        (None, _) => toml::Value::String(text.to_owned()),
    }
}

fn nearest_key(root: &toml::Table, key: &str) -> Option<String> {
    let mut keys = Vec::new();
    collect_keys(root, "", &mut keys);
    // A bare name finds its dotted home (`cnn_depth` -> `model.cnn_depth`).
    let last = |dotted: &str| dotted.rsplit('.').next().unwrap_or(dotted).to_owned();
    if let Some(exact) = keys.iter().find(|candidate| last(candidate) == last(key)) {
        return Some(exact.clone());
    }
    let score = |candidate: &String| {
        strsim::jaro_winkler(candidate, key).max(strsim::jaro_winkler(&last(candidate), &last(key)))
    };
    keys.into_iter().filter(|candidate| score(candidate) > 0.8).max_by(|a, b| score(a).total_cmp(&score(b)))
}

fn collect_keys(table: &toml::Table, prefix: &str, keys: &mut Vec<String>) {
    for (name, value) in table {
        let dotted = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        match value {
            toml::Value::Table(inner) => collect_keys(inner, &dotted, keys),
            _ => keys.push(dotted),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid_and_survive_toml() {
        for preset in [Preset::Debug, Preset::Small, Preset::Paper] {
            for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
                let settings = ModelSettings::preset(preset, kind);
                settings.validate().unwrap();
                let text = toml::to_string(&settings).unwrap();
                assert_eq!(toml::from_str::<ModelSettings>(&text).unwrap(), settings);
            }
        }
    }

    #[test]
    fn the_paper_preset_has_a_state_of_2560() {
        assert_eq!(ModelSettings::preset(Preset::Paper, ModelKind::Rcwm).state_width(), 2560);
    }

    #[test]
    fn unknown_keys_and_wrong_types_are_refused() {
        let mut text = toml::to_string(&ModelSettings::preset(Preset::Debug, ModelKind::Rcwm)).unwrap();
        text.push_str("depht = 3\n");
        assert!(toml::from_str::<ModelSettings>(&text).unwrap_err().to_string().contains("depht"));
        let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        assert!(matches!(with_overrides(&settings, &["units=wide".into()]), Err(SettingsError::Toml(_))));
    }

    #[test]
    fn overrides_reach_the_setting_and_name_the_near_one() {
        let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        let wider = with_overrides(&settings, &["units=64".into(), "unimix=0".into()]).unwrap();
        assert_eq!((wider.units, wider.unimix), (64, 0.0));
        let error = with_overrides(&settings, &["cnn_dept=1".into()]).unwrap_err().to_string();
        assert!(error.contains("did you mean cnn_depth?"), "{error}");
        assert!(matches!(with_overrides(&settings, &["units".into()]), Err(SettingsError::OverrideForm(_))));
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused_with_the_reason() {
        let mut settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        settings.deter = 33;
        assert!(settings.validate().unwrap_err().to_string().contains("k = d / m"));
    }
}
