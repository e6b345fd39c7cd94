//! The kinds of bundles, their parts, and what each part looks like from outside.
//!
//! | kind | parts of a tick | missing frames | surprise |
//! | --- | --- | --- | --- |
//! | `rcwm` | encoder, robot, interaction, environment, actor | imagined | robot, environment |
//! | `dreamer` | encoder, dynamics, actor | imagined | dynamics |
//! | `recurrent` | policy | the last action is held | - |

use serde::{Deserialize, Serialize};

use super::spec::DType::{F32, I64, U8};
use super::spec::TensorSpec;
use crate::settings::{ModelKind, ModelSettings};

/// Which parts a policy has, and so what a runtime can do with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BundleKind {
    /// Robot and environment branch with their interaction.
    Rcwm,
    /// A world model of one branch: DreamerV3 and its kin.
    Dreamer,
    /// Any policy in one graph, with carried state or without.
    Recurrent,
}

impl BundleKind {
    /// The kind that a world model is exported as.
    #[must_use]
    pub const fn of(model: ModelKind) -> Self {
        match model {
            ModelKind::Rcwm => Self::Rcwm,
            ModelKind::Vanilla => Self::Dreamer,
        }
    }

    /// The world model in it; none where the policy has none.
    #[must_use]
    pub const fn model(self) -> Option<ModelKind> {
        match self {
            Self::Rcwm => Some(ModelKind::Rcwm),
            Self::Dreamer => Some(ModelKind::Vanilla),
            Self::Recurrent => None,
        }
    }

    /// The parts of a tick, in the order they run: without them there is no policy.
    #[must_use]
    pub const fn parts(self) -> &'static [PartName] {
        use PartName::{Actor, Dynamics, Encoder, Environment, Interaction, Policy, Robot};
        match self {
            Self::Rcwm => &[Encoder, Robot, Interaction, Environment, Actor],
            Self::Dreamer => &[Encoder, Dynamics, Actor],
            Self::Recurrent => &[Policy],
        }
    }

    /// Parts that may be there beside them.
    #[must_use]
    pub const fn optional_parts(self) -> &'static [PartName] {
        match self {
            Self::Rcwm | Self::Dreamer => &[PartName::Reward, PartName::Continue, PartName::Decoder],
            Self::Recurrent => &[],
        }
    }

    /// Every part that there may be, in the order they run.
    pub fn all_parts(self) -> impl Iterator<Item = PartName> {
        self.parts().iter().chain(self.optional_parts()).copied()
    }

    /// The branches of the world model, in the order they run: each carries z and h, and is surprised.
    #[must_use]
    pub const fn branches(self) -> &'static [PartName] {
        match self {
            Self::Rcwm => &[PartName::Robot, PartName::Environment],
            Self::Dreamer => &[PartName::Dynamics],
            Self::Recurrent => &[],
        }
    }

    /// The name, as in manifests.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Rcwm => "rcwm",
            Self::Dreamer => "dreamer",
            Self::Recurrent => "recurrent",
        }
    }
}

impl std::fmt::Display for BundleKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// The parts of a policy. `n`, `m`, `d`, `c`, `S` and `C` are those of [`ModelSettings`], `k = d / m`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PartName {
    /// Image -> features; of `rcwm` those that both branches share.
    Encoder,
    /// Robot branch with its encoder.
    Robot,
    /// Cross-attention from the environment's z to the robot's prior (eq. 7).
    Interaction,
    /// Environment branch with its encoder.
    Environment,
    /// The one branch of `dreamer`.
    Dynamics,
    /// All of `recurrent`.
    Policy,
    /// Action distribution.
    Actor,
    /// Expected reward (optional).
    Reward,
    /// Probability that the episode goes on (optional).
    Continue,
    /// Images and masks of the branches (optional).
    Decoder,
}

impl PartName {
    /// The name, as in file names and golden tensors.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Encoder => "encoder",
            Self::Robot => "robot",
            Self::Interaction => "interaction",
            Self::Environment => "environment",
            Self::Dynamics => "dynamics",
            Self::Policy => "policy",
            Self::Actor => "actor",
            Self::Reward => "reward",
            Self::Continue => "continue",
            Self::Decoder => "decoder",
        }
    }

    /// Inputs and outputs this part of a world model must have for a model of these sizes, in order. This is the bundle contract; of
    /// [`Self::Policy`], which has no model, it is in [`super::PolicySignature`].
    #[must_use]
    pub fn signature(self, model: &ModelSettings) -> (Vec<TensorSpec>, Vec<TensorSpec>) {
        let (n, m, d) = (model.categoricals, model.classes, model.deter);
        let (side, channels) = (model.image_side, model.image_channels());
        let k = model.interaction_rows();
        let spec = TensorSpec::new;
        let noise = spec("noise", F32, &[2, n, m]);
        // As it was measured: the graph itself takes its symlog.
        let measured = (model.state > 0).then(|| spec("state", F32, &[1, model.state]));
        let state = state_of(model);
        match self {
            Self::Encoder => (vec![spec("image", U8, &[1, side, side, channels])], vec![features(model)]),
            Self::Robot | Self::Dynamics => {
                let mut inputs = vec![
                    spec("z", I64, &[1, n]),
                    spec("h", F32, &[1, d]),
                    spec("action", F32, &[1, model.action]),
                    features(model),
                    noise,
                ];
                inputs.extend(measured);
                (inputs, branch_outputs(model))
            }
            Self::Interaction => (
                vec![
                    spec("robot_prior_z", I64, &[1, n]),
                    spec("robot_h", F32, &[1, d]),
                    spec("environment_z", I64, &[1, n]),
                ],
                vec![spec("e", F32, &[1, n, m]), spec("attention", F32, &[1, n, n + k])],
            ),
            Self::Environment => (
                vec![spec("e", F32, &[1, n, m]), spec("h", F32, &[1, d]), features(model), noise],
                branch_outputs(model),
            ),
            Self::Policy => (Vec::new(), Vec::new()),
            Self::Actor => {
                (state, vec![spec("mean", F32, &[1, model.action]), spec("std", F32, &[1, model.action])])
            }
            Self::Reward => (state, vec![spec("reward", F32, &[1, 1])]),
            Self::Continue => (state, vec![spec("continue_probability", F32, &[1, 1])]),
            Self::Decoder => {
                let image = |name: &str| spec(name, F32, &[1, side, side, channels]);
                let mask = |name: &str| spec(name, F32, &[1, side, side, model.cameras]);
                let pictures = match model.kind {
                    ModelKind::Rcwm => vec![
                        image("image"),
                        image("robot_image"),
                        mask("robot_mask"),
                        image("environment_image"),
                        mask("environment_mask"),
                    ],
                    ModelKind::Vanilla => vec![image("image"), mask("mask")],
                };
                (state, pictures)
            }
        }
    }
}

/// What the encoder gives: of `rcwm` after two convolutions, of `dreamer` after all.
fn features(model: &ModelSettings) -> TensorSpec {
    let c = model.cnn_depth;
    match model.kind {
        ModelKind::Rcwm => {
            TensorSpec::new("features", F32, &[1, 2 * c, model.feature_side(), model.feature_side()])
        }
        ModelKind::Vanilla => TensorSpec::new("features", F32, &[1, 8 * c, 4, 4]),
    }
}

fn branch_outputs(model: &ModelSettings) -> Vec<TensorSpec> {
    let (n, m, d) = (model.categoricals, model.classes, model.deter);
    let spec = TensorSpec::new;
    vec![
        spec("h_next", F32, &[1, d]),
        spec("prior_z", I64, &[1, n]),
        spec("posterior_z", I64, &[1, n]),
        spec("prior_log_probs", F32, &[1, n, m]),
        spec("posterior_log_probs", F32, &[1, n, m]),
    ]
}

/// What actor, heads and decoder read: z and h of every branch.
fn state_of(model: &ModelSettings) -> Vec<TensorSpec> {
    let of = |branch: &PartName| {
        [
            TensorSpec::new(&format!("{branch}_z"), I64, &[1, model.categoricals]),
            TensorSpec::new(&format!("{branch}_h"), F32, &[1, model.deter]),
        ]
    };
    BundleKind::of(model.kind).branches().iter().flat_map(of).collect()
}

impl std::fmt::Display for PartName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}
