//! The sizes of a model: presets, TOML, and dotted overrides (`--set model.cnn_depth=16`).

mod overrides;

use serde::{Deserialize, Serialize};

pub use overrides::{read, with_overrides};

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
    /// Numbers of an action.
    pub action: usize,
    /// Share of the uniform distribution mixed into the class probabilities.
    pub unimix: f64,
    /// `S`: side of the square images, in pixels.
    #[serde(default = "default_image_side", skip_serializing_if = "is_default_image_side")]
    pub image_side: usize,
    /// `C`: cameras whose images the encoder sees side by side on its channels.
    #[serde(default = "default_cameras", skip_serializing_if = "is_default_cameras")]
    pub cameras: usize,
    /// Numbers of the robot's measured state (proprioception); 0: it is not looked at.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub state: usize,
}

/// Sides of images that there are stages of convolutions for.
pub const IMAGE_SIDES: [usize; 2] = [64, 128];
/// Most cameras of a model.
pub const CAMERAS_MAX: usize = 4;
/// Most numbers of an action.
pub const ACTION_NUMBERS_MAX: usize = 64;
/// Most numbers of a measured state.
pub const STATE_NUMBERS_MAX: usize = 1024;

// What is left out of the text where it is the default, so that files of models without it stay as they were.
fn default_image_side() -> usize {
    64
}

fn default_cameras() -> usize {
    1
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks with a reference")]
fn is_default_image_side(side: &usize) -> bool {
    *side == default_image_side()
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks with a reference")]
fn is_default_cameras(cameras: &usize) -> bool {
    *cameras == default_cameras()
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks with a reference")]
fn is_zero(state: &usize) -> bool {
    *state == 0
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
            // The paper's robot: three translations of the hand and the gripper.
            action: 4,
            unimix: 0.01,
            image_side: default_image_side(),
            cameras: default_cameras(),
            state: 0,
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

    /// `3 C`: channels of an image, all cameras.
    #[must_use]
    pub fn image_channels(&self) -> usize {
        3 * self.cameras
    }

    /// Convolutions that halve an image's sides until 4 x 4 are left: 4 for 64, 5 for 128.
    #[must_use]
    pub fn stages(&self) -> usize {
        (self.image_side / 4).ilog2() as usize
    }

    /// Side of the features that the branches share, `S / 4`: two convolutions made them.
    #[must_use]
    pub fn feature_side(&self) -> usize {
        self.image_side / 4
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
        in_range("action", self.action, ACTION_NUMBERS_MAX)?;
        in_range("cameras", self.cameras, CAMERAS_MAX)?;
        if !IMAGE_SIDES.contains(&self.image_side) {
            let [small, large] = IMAGE_SIDES;
            return Err(SettingsError::Invalid(format!(
                "image_side = {}, expected {small} or {large}",
                self.image_side
            )));
        }
        if self.state > STATE_NUMBERS_MAX {
            return Err(SettingsError::Invalid(format!(
                "state = {}, expected 0 (none) to {STATE_NUMBERS_MAX}",
                self.state
            )));
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
    fn sizes_that_are_the_default_are_not_written_and_can_be_set() {
        let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        let text = toml::to_string(&settings).unwrap();
        assert!(!["image_side", "cameras", "state"].iter().any(|key| text.contains(key)), "{text}");
        let sizes = ["image_side=128", "cameras=2", "state=14", "action=7"].map(str::to_owned);
        let other = with_overrides(&settings, &sizes).unwrap();
        assert_eq!((other.image_side, other.cameras, other.state, other.action), (128, 2, 14, 7));
        assert_eq!((other.stages(), other.feature_side(), other.image_channels()), (5, 32, 6));
        other.validate().unwrap();
        assert_eq!(toml::from_str::<ModelSettings>(&toml::to_string(&other).unwrap()).unwrap(), other);
        assert_eq!(with_overrides(&other, &["cameras=1".into(), "state=0".into()]).unwrap().cameras, 1);
        let error = with_overrides(&settings, &["camera=2".into()]).unwrap_err().to_string();
        assert!(error.contains("did you mean cameras?"), "{error}");
    }

    #[test]
    fn sizes_out_of_range_are_refused_with_what_is_accepted() {
        let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        for (change, expected) in [
            ("action=0", "action = 0, expected 1 to 64"),
            ("action=65", "action = 65, expected 1 to 64"),
            ("image_side=96", "image_side = 96, expected 64 or 128"),
            ("cameras=5", "cameras = 5, expected 1 to 4"),
            ("state=1025", "state = 1025, expected 0 (none) to 1024"),
        ] {
            let found = with_overrides(&settings, &[change.to_owned()]).unwrap();
            assert_eq!(found.validate().unwrap_err().to_string(), format!("settings: {expected}"));
        }
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused_with_the_reason() {
        let mut settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
        settings.deter = 33;
        assert!(settings.validate().unwrap_err().to_string().contains("k = d / m"));
    }
}
