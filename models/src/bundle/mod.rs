//! The folder a trainer exports and a runtime deploys.
//!
//! ```text
//! manifest.toml        what follows, with sizes and checksums
//! encoder.onnx ...     one self-contained ONNX file a part
//! initial.safetensors  the state every episode starts from: of each branch `robot/h` [1, d] f32, `robot/z` [1, n] i64; of a policy
//!                      without a world model each `state.NAME`
//! golden.safetensors   ticks of inputs and the outputs the trainer computed for them
//! ```
//!
//! **Golden tensors.** The first dimension counts ticks. Inputs: `input/image` u8 [K, S, S, 3 C], `input/action` f32
//! [K, action] (as executed to get there), `input/is_first` u8 [K], `input/robot_noise` and `input/environment_noise` f32
//! [K, 2, n, m] (first the prior's, then the posterior's), and `input/state` f32 [K, state] (as measured) where the model looks at it. Outputs: `expect/<part>/<output>` with the shapes of
//! [`PartName::signature`], their leading 1 replaced by the number of ticks. Large ones (`features`, images) may cover
//! only the first ticks. The state that enters tick t is the initial one where `is_first`, else the posterior of
//! tick t-1. Kind `recurrent` has `input/CAMERA` u8 [K, H, W, 3] of each camera in place of `input/image`, and no noise; what was
//! carried into tick t is the expected `next_state.NAME` of tick t-1.
//!
//! A bundle comes from outside: nothing in it is believed before [`Bundle::open`] has checked version, sizes, names, paths and
//! checksums, and that no ONNX file refers to data outside itself.

mod error;
mod fits;
mod graph;
mod initial;
mod kind;
mod load;
mod manifest;
mod recurrent;
mod spec;
mod version1;
mod write;

pub use crate::interface::ActionMode;
pub use error::BundleError;
pub use graph::GraphError;
pub use initial::{InitialBranch, InitialState};
pub use kind::{BundleKind, PartName};
pub use load::Bundle;
pub use manifest::{FORMAT, FileEntry, Limits, Manifest, PartEntry, PolicyInputs, Provenance};
pub use recurrent::{CARRIED, CARRIED_NEXT, EXECUTED, Pixels, PolicyInput, PolicyOutput, PolicySignature};
pub use spec::{DType, TensorSpec};
pub use write::{NewBundle, WriteError};

/// File name of the manifest.
pub const MANIFEST_FILE: &str = "manifest.toml";
/// Largest manifest accepted, in bytes.
pub const MANIFEST_BYTES_MAX: u64 = 1 << 17;
/// Largest part accepted, in bytes; the paper's largest is about 25 MB.
pub const PART_BYTES_MAX: u64 = 64 << 20;
/// Most that all parts may hold together, in bytes; all of the paper's hold less than 100 MB. A part is in memory up to three times while
/// it is decoded, so that a bundle is refused with less than 256 MiB, whatever is in it.
pub const PARTS_BYTES_MAX: u64 = 100 << 20;
/// Largest golden file accepted, in bytes.
pub const GOLDEN_BYTES_MAX: u64 = 32 << 20;
