//! What was measured, and on what: without it a figure is nobody's.

use rcwm_models::bundle::{Bundle, BundleKind, MANIFEST_FILE};
use rcwm_models::files::{FileError, read_capped, sha256_hex};
use rcwm_models::machine::Machine;
use serde::{Deserialize, Serialize};

/// The machine and the programs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct System {
    #[serde(flatten)]
    pub machine: Machine,
    /// Of this program.
    pub version: String,
    /// Of its source; `-dirty` where files were changed since.
    pub revision: String,
    /// That built it.
    pub compiler: String,
    /// The other engine's library, where there is one.
    pub onnxruntime: Option<String>,
    /// Date and time, UTC.
    pub date: String,
}

/// The bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Measured {
    pub name: String,
    pub kind: BundleKind,
    pub preset: String,
    /// Of the manifest, which holds the checksums of all else.
    pub sha256: String,
}

impl System {
    /// This machine, now.
    #[must_use]
    pub fn here() -> Self {
        let library = std::env::var_os("ORT_DYLIB_PATH").and_then(|path| std::fs::canonicalize(path).ok());
        Self {
            machine: Machine::here(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: env!("RCWM_SOURCE_REVISION").to_owned(),
            compiler: env!("RCWM_COMPILER").to_owned(),
            onnxruntime: library.and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned())),
            date: jiff::Timestamp::now().strftime("%Y-%m-%d %H:%M").to_string(),
        }
    }

    /// For people.
    pub(super) fn lines(&self) -> String {
        let Machine { processor, cores, architecture, kernel, governor, virtualised } = &self.machine;
        let machine = if *virtualised { "virtual machine" } else { "bare machine" };
        format!(
            "system     {processor}, {cores} cores, {architecture}, {machine}; Linux {kernel}, governor {governor}\n\
             program    {} {}, {}; {}\n",
            self.version,
            self.revision,
            self.compiler,
            self.onnxruntime.as_deref().unwrap_or("no ONNX Runtime"),
        )
    }
}

impl Measured {
    /// # Errors
    /// Where the manifest can no longer be read.
    pub(super) fn of(bundle: &Bundle) -> Result<Self, FileError> {
        let manifest =
            read_capped(&bundle.folder.join(MANIFEST_FILE), rcwm_models::bundle::MANIFEST_BYTES_MAX)?;
        let folder = std::fs::canonicalize(&bundle.folder).unwrap_or_else(|_| bundle.folder.clone());
        Ok(Self {
            name: folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
            kind: bundle.manifest.kind,
            preset: bundle.manifest.provenance.preset.clone(),
            sha256: sha256_hex(&manifest),
        })
    }
}
