//! Strict loading: nothing is believed before it was checked.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use prost::Message;

use super::error::BundleError;
use super::graph;
use super::initial::{InitialState, read_initial};
use super::kind::PartName;
use super::manifest::{FORMAT, FileEntry, Manifest, PartEntry};
use super::recurrent::PolicySignature;
use super::spec::{DType, TensorSpec};
use super::version1::ManifestV1;
use super::{GOLDEN_BYTES_MAX, MANIFEST_BYTES_MAX, MANIFEST_FILE, PART_BYTES_MAX, PARTS_BYTES_MAX};
use crate::files::{read_capped, sha256_hex};
use crate::onnx::{self, OnnxError};
use crate::settings::ModelKind;
use crate::tensors::Tensors;

/// Largest file of initial states accepted, in bytes.
const INITIAL_BYTES_MAX: u64 = 1 << 20;

/// A bundle whose every file was checked and is in memory, so that what was checked is what runs.
#[derive(Debug, Clone)]
pub struct Bundle {
    /// The folder it came from.
    pub folder: PathBuf,
    pub manifest: Manifest,
    /// The ONNX files' bytes, without what the checks do not know: an engine sees nothing that was not checked.
    pub parts: BTreeMap<PartName, Vec<u8>>,
    pub initial: InitialState,
    /// Golden inputs and outputs, see [`super`].
    pub golden: Tensors,
}

impl Bundle {
    /// Reads and checks a bundle folder.
    ///
    /// # Errors
    /// See [`BundleError`]; nothing of a refused bundle is kept.
    pub fn open(folder: &Path) -> Result<Self, BundleError> {
        let manifest = read_manifest(&folder.join(MANIFEST_FILE))?;
        let mut parts = BTreeMap::new();
        for entry in &manifest.parts {
            let bytes = read_entry(folder, &entry.file_entry(), PART_BYTES_MAX)?;
            let model = check_graph(entry, bytes, manifest.model.as_ref().map_or(0, |model| model.classes))?;
            parts.insert(entry.name, model.encode_to_vec());
        }
        let initial = read_tensors(folder, &manifest.initial, INITIAL_BYTES_MAX)
            .and_then(|tensors| read_initial(&manifest, &tensors))?;
        let golden = read_tensors(folder, &manifest.golden, GOLDEN_BYTES_MAX)?;
        Ok(Self { folder: folder.to_path_buf(), manifest, parts, initial, golden })
    }

    /// The bytes of a part that the bundle may or may not have.
    #[must_use]
    pub fn part(&self, name: PartName) -> Option<&[u8]> {
        self.parts.get(&name).map(Vec::as_slice)
    }
}

impl PartEntry {
    /// File, size and checksum.
    #[must_use]
    pub fn file_entry(&self) -> FileEntry {
        FileEntry { file: self.file.clone(), bytes: self.bytes, sha256: self.sha256.clone() }
    }
}

fn read_manifest(path: &Path) -> Result<Manifest, BundleError> {
    let wrong = |reason: String| BundleError::Manifest { path: path.to_path_buf(), reason };
    let bytes = read_capped(path, MANIFEST_BYTES_MAX)?;
    let text = String::from_utf8(bytes).map_err(|error| wrong(error.to_string()))?;
    // The version first: a later format may have other keys, and should be told apart from a damaged file.
    #[derive(serde::Deserialize)]
    struct Versioned {
        format: u32,
    }
    let not_understood = |error: toml::de::Error| wrong(said_of(&error, &text));
    let Versioned { format } = toml::from_str(&text).map_err(not_understood)?;
    let manifest = match format {
        1 => Manifest::from(toml::from_str::<ManifestV1>(&text).map_err(not_understood)?),
        FORMAT => toml::from_str(&text).map_err(not_understood)?,
        found => return Err(BundleError::Format { found }),
    };
    manifest.check()?;
    Ok(manifest)
}

/// Line and reason, without the text around it: a line of a file from outside may be as long as the file.
fn said_of(error: &toml::de::Error, text: &str) -> String {
    const SHOWN_MAX: usize = 300;
    let before = error.span().and_then(|span| text.as_bytes().get(..span.start));
    let line = before.map(|before| 1 + before.iter().filter(|byte| **byte == b'\n').count());
    let reason: String = error.message().split_whitespace().collect::<Vec<_>>().join(" ");
    let shown: String = reason.chars().take(SHOWN_MAX).collect();
    let cut = if shown.len() < reason.len() { " ..." } else { "" };
    line.map_or_else(|| format!("{shown}{cut}"), |line| format!("line {line}: {shown}{cut}"))
}

impl Manifest {
    /// Checks everything that can be checked without reading another file.
    pub fn check(&self) -> Result<(), BundleError> {
        self.check_kind()?;
        self.interface.check().map_err(|error| BundleError::Invalid(error.to_string()))?;
        self.check_limits()?;
        self.check_inputs()?;
        if let Some(model) = &self.model {
            model.validate()?;
            self.check_sizes(model)?;
        }
        for part in self.kind.parts() {
            if self.part(*part).is_none() {
                return Err(BundleError::Part { part: *part, problem: "missing" });
            }
        }
        let bytes = self.parts.iter().fold(0_u64, |sum, entry| sum.saturating_add(entry.bytes));
        if bytes > PARTS_BYTES_MAX {
            return Err(BundleError::Invalid(format!(
                "the parts hold {bytes} bytes together, at most {PARTS_BYTES_MAX} are accepted"
            )));
        }
        for (index, entry) in self.parts.iter().enumerate() {
            if self.parts[..index].iter().any(|before| before.name == entry.name) {
                return Err(BundleError::Part { part: entry.name, problem: "listed twice" });
            }
            if !self.kind.all_parts().any(|part| part == entry.name) {
                return Err(BundleError::OtherKind { part: entry.name, kind: self.kind });
            }
            let Some(model) = &self.model else {
                PolicySignature::of(self, entry)?;
                continue;
            };
            let (inputs, outputs) = entry.name.signature(model);
            expect_specs(entry.name, "the manifest's inputs", &entry.inputs, &inputs)?;
            expect_specs(entry.name, "the manifest's outputs", &entry.outputs, &outputs)?;
        }
        Ok(())
    }

    /// Kind and model go together.
    fn check_kind(&self) -> Result<(), BundleError> {
        let (found, expected) = (self.model.as_ref().map(|model| model.kind), self.kind.model());
        if found == expected {
            return Ok(());
        }
        let said = |kind: Option<ModelKind>| match kind {
            None => "no [model]",
            Some(ModelKind::Rcwm) => "model.kind = \"rcwm\"",
            Some(ModelKind::Vanilla) => "model.kind = \"vanilla\"",
        };
        Err(BundleError::Invalid(format!(
            "kind = \"{}\" with {}, expected {}",
            self.kind,
            said(found),
            said(expected)
        )))
    }
}

fn expect_specs(
    part: PartName,
    role: &'static str,
    found: &[TensorSpec],
    expected: &[TensorSpec],
) -> Result<(), BundleError> {
    if found == expected {
        return Ok(());
    }
    let list = |specs: &[TensorSpec]| {
        let each = specs.iter().map(|spec| format!("{} {:?} {:?}", spec.name, spec.dtype, spec.shape));
        each.collect::<Vec<_>>().join(", ")
    };
    Err(BundleError::Signature { part, role, found: list(found), expected: list(expected) })
}

fn read_entry(folder: &Path, entry: &FileEntry, bytes_max: u64) -> Result<Vec<u8>, BundleError> {
    let mut components = Path::new(&entry.file).components();
    let plain = matches!((components.next(), components.next()), (Some(Component::Normal(_)), None));
    if !plain || entry.file.contains(['\\', '\0', '/']) {
        return Err(BundleError::OutsidePath { name: entry.file.clone() });
    }
    let bytes = read_capped(&folder.join(&entry.file), bytes_max)?;
    let mismatch = |what, found: String, expected: String| {
        Err(BundleError::Mismatch { file: entry.file.clone(), what, found, expected })
    };
    if bytes.len() as u64 != entry.bytes {
        return mismatch("size", bytes.len().to_string(), entry.bytes.to_string());
    }
    let sha256 = sha256_hex(&bytes);
    if sha256 != entry.sha256 {
        return mismatch("sha256", sha256, entry.sha256.clone());
    }
    Ok(bytes)
}

fn check_graph(entry: &PartEntry, bytes: Vec<u8>, classes: usize) -> Result<onnx::Model, BundleError> {
    let part = entry.name;
    let model = onnx::parse_self_contained(&bytes).map_err(|source| BundleError::Onnx { part, source })?;
    // Not kept beside what was read from it.
    drop(bytes);
    let graph = model.graph.as_ref().ok_or(BundleError::Onnx { part, source: OnnxError::NoGraph })?;
    let specs = |values: &[onnx::ValueInfo]| -> Option<Vec<TensorSpec>> {
        values
            .iter()
            .map(|value| {
                let (elem_type, shape) = value.fixed()?;
                Some(TensorSpec { name: value.name.clone(), dtype: DType::from_onnx(elem_type)?, shape })
            })
            .collect()
    };
    for (role, values, expected) in [
        ("the graph's inputs", &graph.input, &entry.inputs),
        ("the graph's outputs", &graph.output, &entry.outputs),
    ] {
        expect_specs(part, role, &specs(values).unwrap_or_default(), expected)?;
    }
    graph::check(&model, &entry.inputs, &entry.outputs, classes)
        .map_err(|source| BundleError::Graph { part, source })?;
    Ok(model)
}

fn read_tensors(folder: &Path, entry: &FileEntry, bytes_max: u64) -> Result<Tensors, BundleError> {
    let bytes = read_entry(folder, entry, bytes_max)?;
    Tensors::of_few(&bytes).map_err(|source| BundleError::Tensors { file: entry.file.clone(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(text: &str) -> String {
        said_of(&toml::from_str::<Manifest>(text).unwrap_err(), text)
    }

    #[test]
    fn what_is_wrong_with_a_manifest_is_one_short_line_with_its_number() {
        let text = said("format = 1\ntask = \"a\"\nother = 3\n");
        assert!(text.starts_with("line 3: ") && text.contains("other"), "{text}");
        for long in [
            format!("x = {}", "[".repeat(50_000)),
            format!("{}ü = 1", "k".repeat(50_000)),
            "a.".repeat(50_000),
        ] {
            let text = said(&long);
            assert!(text.len() < 700 && !text.contains('\n'), "{} bytes", text.len());
        }
    }
}
