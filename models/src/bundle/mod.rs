//! The folder a trainer exports and a runtime deploys.
//!
//! ```text
//! manifest.toml        what follows, with sizes and checksums
//! encoder.onnx ...     one self-contained ONNX file a part
//! initial.safetensors  the learned initial state of each branch: `robot/h` [1, d] f32, `robot/z` [1, n] i64, `environment/...`
//! golden.safetensors   ticks of inputs and the outputs the trainer computed for them
//! ```
//!
//! **Golden tensors.** The first dimension counts ticks. Inputs: `input/image` u8 [K, S, S, 3 C], `input/action` f32
//! [K, action] (as executed to get there), `input/is_first` u8 [K], `input/robot_noise` and `input/environment_noise` f32
//! [K, 2, n, m] (first the prior's, then the posterior's), and `input/state` f32 [K, state] (as measured) where the model looks at it. Outputs: `expect/<part>/<output>` with the shapes of
//! [`PartName::signature`], their leading 1 replaced by the number of ticks. Large ones (`features`, images) may cover
//! only the first ticks. The state that enters tick t is the initial one where `is_first`, else the posterior of
//! tick t-1.
//!
//! A bundle comes from outside: nothing in it is believed before [`Bundle::open`] has checked version, sizes, names, paths and
//! checksums, and that no ONNX file refers to data outside itself.

mod fits;
mod graph;
mod load;
mod manifest;
mod version1;

pub use crate::interface::ActionMode;
pub use graph::GraphError;
pub use load::{Bundle, BundleError, InitialState};
pub use manifest::{
    BundleKind, DType, FORMAT, FileEntry, Limits, Manifest, PartEntry, PartName, PolicyInputs, Provenance,
    TensorSpec,
};

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
