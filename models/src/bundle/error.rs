//! Why a bundle was refused.

use std::path::PathBuf;

use super::graph::GraphError;
use super::kind::{BundleKind, PartName};
use super::manifest::FORMAT;
use crate::files::FileError;
use crate::onnx::OnnxError;
use crate::settings::SettingsError;
use crate::tensors::TensorsError;

/// Why a bundle was refused.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// A file is missing, unreadable, too large or a link.
    #[error("bundle: {0}")]
    File(#[from] FileError),
    /// The manifest is not TOML of the expected form.
    #[error("bundle: {path}: {reason}")]
    Manifest {
        /// The manifest.
        path: PathBuf,
        reason: String,
    },
    /// The bundle was written for another version.
    #[error(
        "bundle: format {found}, this program reads formats 1 and {FORMAT}; export it again with the matching trainer"
    )]
    Format {
        /// The format found.
        found: u32,
    },
    /// The sizes do not fit together.
    #[error("bundle: {0}")]
    Settings(#[from] SettingsError),
    /// A file name points out of the folder.
    #[error("bundle: file name {name:?} is not a plain name inside the bundle")]
    OutsidePath { name: String },
    /// A file is not the one that was exported.
    #[error(
        "bundle: {file}: {what} is {found}, the manifest says {expected}; copy or export the bundle again"
    )]
    Mismatch {
        file: String,
        /// `size` or `sha256`.
        what: &'static str,
        found: String,
        /// What it must be.
        expected: String,
    },
    /// A part that every policy needs is not listed, or one is listed twice.
    #[error("bundle: part {part} is {problem}")]
    Part {
        part: PartName,
        /// `missing` or `listed twice`.
        problem: &'static str,
    },
    /// A part of another kind of bundle.
    #[error("bundle: part {part} is not one of kind {kind}")]
    OtherKind { part: PartName, kind: BundleKind },
    /// A part is not the ONNX this runtime runs.
    #[error("bundle: {part}: {source}")]
    Onnx { part: PartName, source: OnnxError },
    /// A part's graph does something that it must not.
    #[error("bundle: {part}: {source}; export it again: docs/own-policy.md lists the operators")]
    Graph {
        part: PartName,
        /// What it does.
        source: GraphError,
    },
    /// A part's inputs or outputs are not those of the contract.
    #[error("bundle: {part}: {role} are {found}, expected {expected}")]
    Signature {
        part: PartName,
        /// `inputs` or `outputs`, of the manifest or of the graph.
        role: &'static str,
        /// What was found.
        found: String,
        /// What the contract says.
        expected: String,
    },
    /// Initial states or golden values are unusable.
    #[error("bundle: {file}: {source}")]
    Tensors { file: String, source: TensorsError },
    /// A value is out of its range.
    #[error("bundle: {0}")]
    Invalid(String),
}
