//! From the exported ONNX files to what the tick runs.
//!
//! 1. [`join`]: the parts become one graph, the whole tick, as they hang together in time.
//! 2. [`fuse`]: groups of nodes that are hot become one node of our own each, and layouts are changed where that saves copies.
//! 3. [`segments`]: the graph is cut into pieces that run one after another: per part, what can be known before the image is there (*early*) and
//!    what cannot (*late*).
//!
//! All of it is a rewriting of ONNX graphs: what runs is what the files say, and a group of nodes that is not recognised stays as it is, for
//! tract to run. Names of values are `part/name`; those of the tick's own inputs are in [`inputs`].

mod fuse;
mod graph;
mod join;
mod pattern;
mod segments;

pub use graph::{Fact, Graph};
pub use segments::Segment;

use rcwm_models::bundle::{Bundle, PartName};

/// Names of the tick's inputs.
pub mod inputs {
    /// The image; all that depends on it is late.
    pub const IMAGE: &str = "image";
    /// The measured state, as late as the image.
    pub const STATE: &str = "state";
    /// The executed action.
    pub const ACTION: &str = "action";

    /// What is a branch's own: its carried posterior `z` and `h`, and its Gumbel `noise`.
    #[must_use]
    pub fn of_branch(branch: rcwm_models::bundle::PartName, name: &str) -> String {
        format!("{branch}.{name}")
    }
}

/// What is done to the graph beside cutting it; each can be left out to see what it brings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Optimizations {
    /// LayerNorm and `SiLU` as one node.
    pub norms: bool,
    /// Convolution, norm and `SiLU` as one node, channels last, padding and byte conversion within.
    pub convolutions: bool,
    /// Products with packed weights, sums of table rows, biases, norm and `SiLU` as one node; softmax, uniform share and logarithm as
    /// one node; noise and argmax as one node.
    pub layers: bool,
    /// Weights of layers kept in 16 bits; changes results a little, so it is not done by default.
    pub half_weights: bool,
}

impl Optimizations {
    /// All that keep the results as they are (up to rounding).
    pub const EXACT: Self = Self { norms: true, convolutions: true, layers: true, half_weights: false };
    pub const NONE: Self = Self { norms: false, convolutions: false, layers: false, half_weights: false };
}

impl Default for Optimizations {
    fn default() -> Self {
        Self::EXACT
    }
}

/// Why a bundle's parts could not be made into a tick.
#[derive(Debug, thiserror::Error)]
pub enum CompileError {
    /// A part cannot be read.
    #[error(
        "compiling {part}: {reason}; export the bundle again, or run its parts as they are with --engine ort"
    )]
    Part { part: PartName, reason: String },
}

/// The segments of a bundle's tick, in the order they run.
///
/// # Errors
/// [`CompileError::Part`].
pub fn compile(bundle: &Bundle, optimizations: Optimizations) -> Result<Vec<Segment>, CompileError> {
    let mut graph = join::join(bundle)?;
    fuse::fuse(&mut graph, optimizations);
    Ok(segments::cut(&graph, bundle.manifest.kind.parts()))
}

/// The tick as it was exported, as two files: what can be known before the image is there, and the rest. What any engine can work ahead, too.
///
/// # Errors
/// [`CompileError::Part`].
pub fn halve(bundle: &Bundle) -> Result<[Segment; 2], CompileError> {
    let graph = join::join(bundle)?;
    let reason =
        |reason: &str| CompileError::Part { part: bundle.manifest.kind.parts()[0], reason: reason.into() };
    let mut opsets = graph.opsets.values();
    let first = opsets.next();
    if opsets.any(|opset| Some(opset) != first) {
        return Err(reason("the parts are of several operator sets, and cannot be one graph"));
    }
    segments::halve(&graph).ok_or_else(|| reason("the tick does not come apart where the image comes in"))
}
