//! Bundles of version 1, which had no interface: four displacements or positions, one picture of 64 x 64.

use serde::Deserialize;

use super::manifest::{BundleKind, FORMAT, FileEntry, Limits, Manifest, PartEntry, PolicyInputs, Provenance};
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
            model: old.model,
            interface,
            policy: PolicyInputs { inputs, limits },
            provenance: old.provenance,
            initial: old.initial,
            golden: old.golden,
            parts: old.parts,
        }
    }
}
