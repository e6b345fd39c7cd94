//! `manifest.toml`, typed. Unknown keys are refused.

use serde::{Deserialize, Serialize};

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
    /// The sizes of the model.
    pub model: ModelSettings,
    /// What a robot must offer, and the limits of what it is commanded.
    pub interface: Interface,
    pub policy: PolicyInputs,
    /// Where it comes from.
    pub provenance: Provenance,
    /// The learned initial state.
    pub initial: FileEntry,
    /// Inputs and expected outputs.
    pub golden: FileEntry,
    /// The ONNX files, in the order they run.
    pub parts: Vec<PartEntry>,
}

/// Which parts a policy has, and so what a runtime can do with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BundleKind {
    /// Robot and environment branch with their interaction.
    Rcwm,
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

/// A tensor that enters or leaves a part.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TensorSpec {
    /// Name in the graph.
    pub name: String,
    /// Element type.
    pub dtype: DType,
    /// Every dimension is fixed.
    pub shape: Vec<usize>,
}

impl TensorSpec {
    /// A tensor of this name, type and shape.
    #[must_use]
    pub fn new(name: &str, dtype: DType, shape: &[usize]) -> Self {
        Self { name: name.to_owned(), dtype, shape: shape.to_vec() }
    }
}

/// Element types that cross a part's border.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DType {
    /// 8-bit unsigned: images.
    U8,
    /// 64-bit signed: class indices.
    I64,
    /// 32-bit float.
    F32,
}

/// The parts of a policy. `n`, `m`, `d`, `c`, `S` and `C` are those of [`ModelSettings`], `k = d / m`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PartName {
    /// Shared encoder: image -> features.
    Encoder,
    /// Robot branch with its encoder.
    Robot,
    /// Cross-attention from the environment's z to the robot's prior (eq. 7).
    Interaction,
    /// Environment branch with its encoder.
    Environment,
    /// Action distribution.
    Actor,
    /// Expected reward (optional).
    Reward,
    /// Probability that the episode goes on (optional).
    Continue,
    /// Images and masks of both branches (optional).
    Decoder,
}

impl PartName {
    /// All parts, in the order they run.
    pub const ALL: [Self; 8] = [
        Self::Encoder,
        Self::Robot,
        Self::Interaction,
        Self::Environment,
        Self::Actor,
        Self::Reward,
        Self::Continue,
        Self::Decoder,
    ];

    /// The parts without which there is no policy.
    pub const REQUIRED: [Self; 5] =
        [Self::Encoder, Self::Robot, Self::Interaction, Self::Environment, Self::Actor];

    /// The name, as in file names and golden tensors.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Encoder => "encoder",
            Self::Robot => "robot",
            Self::Interaction => "interaction",
            Self::Environment => "environment",
            Self::Actor => "actor",
            Self::Reward => "reward",
            Self::Continue => "continue",
            Self::Decoder => "decoder",
        }
    }

    /// Inputs and outputs this part must have for a model of these sizes, in order. This is the bundle contract.
    #[must_use]
    pub fn signature(self, model: &ModelSettings) -> (Vec<TensorSpec>, Vec<TensorSpec>) {
        use DType::{F32, I64, U8};
        let (n, m, d) = (model.categoricals, model.classes, model.deter);
        let (side, channels, small) = (model.image_side, model.image_channels(), model.feature_side());
        let k = model.interaction_rows();
        let spec = TensorSpec::new;
        let features = spec("features", F32, &[1, 2 * model.cnn_depth, small, small]);
        let noise = spec("noise", F32, &[2, n, m]);
        let branch_outputs = || {
            vec![
                spec("h_next", F32, &[1, d]),
                spec("prior_z", I64, &[1, n]),
                spec("posterior_z", I64, &[1, n]),
                spec("prior_log_probs", F32, &[1, n, m]),
                spec("posterior_log_probs", F32, &[1, n, m]),
            ]
        };
        let state = || {
            vec![
                spec("robot_z", I64, &[1, n]),
                spec("robot_h", F32, &[1, d]),
                spec("environment_z", I64, &[1, n]),
                spec("environment_h", F32, &[1, d]),
            ]
        };
        match self {
            Self::Encoder => (vec![spec("image", U8, &[1, side, side, channels])], vec![features]),
            Self::Robot => {
                let mut inputs = vec![
                    spec("z", I64, &[1, n]),
                    spec("h", F32, &[1, d]),
                    spec("action", F32, &[1, model.action]),
                    features,
                    noise,
                ];
                // As it was measured: the graph itself takes its symlog.
                inputs.extend((model.state > 0).then(|| spec("state", F32, &[1, model.state])));
                (inputs, branch_outputs())
            }
            Self::Interaction => (
                vec![
                    spec("robot_prior_z", I64, &[1, n]),
                    spec("robot_h", F32, &[1, d]),
                    spec("environment_z", I64, &[1, n]),
                ],
                vec![spec("e", F32, &[1, n, m]), spec("attention", F32, &[1, n, n + k])],
            ),
            Self::Environment => {
                (vec![spec("e", F32, &[1, n, m]), spec("h", F32, &[1, d]), features, noise], branch_outputs())
            }
            Self::Actor => {
                (state(), vec![spec("mean", F32, &[1, model.action]), spec("std", F32, &[1, model.action])])
            }
            Self::Reward => (state(), vec![spec("reward", F32, &[1, 1])]),
            Self::Continue => (state(), vec![spec("continue_probability", F32, &[1, 1])]),
            Self::Decoder => {
                let image = |name| spec(name, F32, &[1, side, side, channels]);
                let mask = |name| spec(name, F32, &[1, side, side, model.cameras]);
                (
                    state(),
                    vec![
                        image("image"),
                        image("robot_image"),
                        mask("robot_mask"),
                        image("environment_image"),
                        mask("environment_mask"),
                    ],
                )
            }
        }
    }
}

impl std::fmt::Display for PartName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}
