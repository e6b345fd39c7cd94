//! Operators of our own that tract runs in place of groups of standard ones. They stand in the graphs that [`crate::compile`] writes, in a
//! domain of their own; what they compute is in [`rcwm_kernels::tick`].
//!
//! Each keeps its results in memory of its own, which is used again as soon as nobody reads them any more: a tick allocates nothing here.

mod build;
mod compute;
mod convolution;
mod custom_op;
mod latents;
mod layer;
mod memory;
mod norm;
mod shared;

use std::sync::Arc;

use tract_onnx::prelude::TypedModel;

use custom_op::CustomOp;
use rcwm_kernels::team::Team;

/// Domain of the operators.
pub const DOMAIN: &str = "rcwm";
/// LayerNorm, perhaps with `SiLU`.
pub const NORM: &str = "RcwmNorm";
/// Convolution, norm and `SiLU`, channels last.
pub const CONV: &str = "RcwmConv";
/// Sum of products, rows and values, perhaps with norm and `SiLU`.
pub const LAYER: &str = "RcwmLayer";
/// Logits to log-probabilities.
pub const LOG_PROBS: &str = "RcwmLogProbs";
/// Log-probabilities and noise to classes.
pub const DRAW: &str = "RcwmDraw";

/// What a layer sums.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Term {
    /// A row times a matrix: inputs x, matrix.
    Product,
    /// One table row per latent: inputs z, offsets, table.
    Rows,
    /// A value as it is: one input.
    Value,
}

impl Term {
    /// How it is written in the attribute `terms`.
    #[must_use]
    pub const fn letter(self) -> char {
        match self {
            Self::Product => 'p',
            Self::Rows => 'r',
            Self::Value => 'v',
        }
    }

    /// The term of a letter.
    #[must_use]
    pub const fn of_letter(letter: u8) -> Option<Self> {
        match letter {
            b'p' => Some(Self::Product),
            b'r' => Some(Self::Rows),
            b'v' => Some(Self::Value),
            _ => None,
        }
    }
}

/// A team that operators of one thread share.
pub type SharedTeam = Arc<Team>;

/// tract's ONNX reader, with our operators.
#[must_use]
pub fn onnx() -> tract_onnx::Onnx {
    let mut onnx = tract_onnx::onnx();
    onnx.op_register.insert(NORM, norm::build);
    onnx.op_register.insert(CONV, convolution::build);
    onnx.op_register.insert(LAYER, layer::build);
    onnx.op_register.insert(LOG_PROBS, latents::build_log_probs);
    onnx.op_register.insert(DRAW, latents::build_draw);
    onnx
}

/// Tells our operators of a model with whom to share large work.
pub fn bind_threads(model: &mut TypedModel, team: Option<&SharedTeam>) {
    for node in &mut model.nodes {
        CustomOp::<convolution::Block>::bind_threads(node, team);
        CustomOp::<layer::Layer>::bind_threads(node, team);
    }
}
