//! `manifest.toml`, typed. Unknown keys are refused.

use serde::{Deserialize, Serialize};

use super::kind::{BundleKind, PartName};
use super::spec::TensorSpec;
use crate::interface::Interface;
use crate::settings::ModelSettings;

/// Version of the bundle format this crate reads and writes.
pub const FORMAT: u32 = 2;

/// Everything known about a bundle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// [`FORMAT`].
    pub format: u32,
    pub kind: BundleKind,
    /// Name of the task the policy was made for, or `own`.
    pub task: String,
    /// The sizes of the world model; kind `recurrent` has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelSettings>,
    /// What a robot must offer, and the limits of what it is commanded.
    pub interface: Interface,
    pub policy: PolicyInputs,
    /// Where it comes from.
    pub provenance: Provenance,
    /// The state that every episode starts from.
    pub initial: FileEntry,
    /// Inputs and expected outputs.
    pub golden: FileEntry,
    /// The ONNX files, in the order they run.
    pub parts: Vec<PartEntry>,
}

/// What of the interface the policy reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyInputs {
    /// Names of cameras and states; cameras in the order of their channels.
    pub inputs: Vec<String>,
    /// Limits within those of the interface, in its units, that no action of this policy leaves; none: those of the interface.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<Limits>,
}

/// Smallest and largest value of each number of an action.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    pub low: Vec<f32>,
    pub high: Vec<f32>,
}

/// Where a bundle comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// `debug`, `small`, `paper` or `custom`.
    pub preset: String,
    /// What it was trained on, in words.
    pub data: String,
    /// World-model updates behind the weights; 0 is untrained.
    pub updates: u64,
    /// The seeds used.
    pub seeds: Vec<u64>,
    /// Revision of the source that exported it.
    pub source_revision: String,
}

/// A file of the bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileEntry {
    /// Plain file name inside the folder.
    pub file: String,
    /// Size in bytes.
    pub bytes: u64,
    /// sha256, lower-case hexadecimal.
    pub sha256: String,
}

/// One ONNX file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartEntry {
    pub name: PartName,
    /// Plain file name inside the folder.
    pub file: String,
    /// Size in bytes.
    pub bytes: u64,
    /// sha256, lower-case hexadecimal.
    pub sha256: String,
    /// Its inputs, in the graph's order.
    pub inputs: Vec<TensorSpec>,
    /// Its outputs, in the graph's order.
    pub outputs: Vec<TensorSpec>,
}

impl Manifest {
    /// The entry of a part that the bundle may or may not have.
    #[must_use]
    pub fn part(&self, name: PartName) -> Option<&PartEntry> {
        self.parts.iter().find(|part| part.name == name)
    }
}
