//! Bundles of version 1, which had no interface: four displacements or positions, one picture of 64 x 64.

use serde::Deserialize;

use super::BundleKind;
use super::manifest::{FORMAT, FileEntry, Limits, Manifest, PartEntry, PolicyInputs, Provenance};
use crate::interface::{ActionMode, Fallback, FallbackRule, Interface};
use crate::settings::ModelSettings;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestV1 {
    #[serde(rename = "format")]
    _format: u32,
    task: String,
    model: ModelSettings,
    control: ControlV1,
    provenance: Provenance,
    initial: FileEntry,
    golden: FileEntry,
    parts: Vec<PartEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ControlV1 {
    rate_hz: f64,
    action_low: [f32; 4],
    action_high: [f32; 4],
    #[serde(default)]
    action_mode: ActionMode,
}

impl From<ManifestV1> for Manifest {
    /// The interface is that of Meta-World's arm, with the bundle's rate and mode; narrower limits are the policy's.
    fn from(old: ManifestV1) -> Self {
        let mut interface = Interface::metaworld();
        interface.rate_hz = old.control.rate_hz;
        for action in &mut interface.action {
            action.mode = old.control.action_mode;
            if action.mode == ActionMode::Absolute {
                action.fallback = Fallback::Rule(FallbackRule::Hold);
            }
        }
        let inputs = interface.camera.iter().map(|camera| camera.name.clone()).collect();
        let ControlV1 { action_low, action_high, .. } = old.control;
        let narrower = action_low != [-1.0; 4] || action_high != [1.0; 4];
        let limits = narrower.then(|| Limits { low: action_low.into(), high: action_high.into() });
        Self {
            format: FORMAT,
            kind: BundleKind::Rcwm,
            task: old.task,
            model: Some(old.model),
            interface,
            policy: PolicyInputs { inputs, limits },
            provenance: old.provenance,
            initial: old.initial,
            golden: old.golden,
            parts: old.parts,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bundle_of_version_1_is_read_as_one_of_metaworlds_arm() {
        let text = include_str!("version1.toml");
        let read = |text: &str| Manifest::from(toml::from_str::<ManifestV1>(text).unwrap());
        let manifest = read(text);
        manifest.check().unwrap();
        assert_eq!((manifest.interface.clone(), manifest.format), (Interface::metaworld(), FORMAT));
        assert!(manifest.policy.limits.is_none() && manifest.policy.inputs == ["image"]);
        let narrow = read(&text.replace("action_low = [-1.0, -1.0", "action_low = [-0.5, -1.0"));
        narrow.check().unwrap();
        assert_eq!((narrow.limits().low[0], narrow.limits().high[0]), (-0.5, 1.0));
        let positions = read(&text.replace("[provenance]", "action_mode = \"absolute\"\n\n[provenance]"));
        positions.check().unwrap();
        assert_eq!(positions.interface.action[0].mode, ActionMode::Absolute);
    }
}
