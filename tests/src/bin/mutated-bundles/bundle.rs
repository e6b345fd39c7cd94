//! The sound bundle, and damaged copies of it in a folder.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
use rcwm_models::bundle::{Bundle, MANIFEST_FILE};
use rcwm_models::files::sha256_hex;

/// Files by name.
pub(crate) type Files = BTreeMap<String, Vec<u8>>;

/// The sound bundle's files.
pub(crate) struct Original {
    pub(crate) files: Files,
    /// Files other than the manifest.
    pub(crate) listed: Vec<String>,
    /// Those that are ONNX.
    pub(crate) parts: Vec<String>,
}

impl Original {
    pub(crate) fn read(folder: &Path) -> anyhow::Result<Self> {
        let manifest = Bundle::open(folder)?.manifest;
        let parts: Vec<String> = manifest.parts.iter().map(|entry| entry.file.clone()).collect();
        let tensors = [manifest.initial.file, manifest.golden.file];
        let listed: Vec<String> = parts.iter().cloned().chain(tensors).collect();
        let mut files = Files::new();
        for name in listed.iter().cloned().chain([MANIFEST_FILE.to_owned()]) {
            let path = folder.join(&name);
            files.insert(name, std::fs::read(&path).with_context(|| path.display().to_string())?);
        }
        Ok(Self { files, listed, parts })
    }

    pub(crate) fn manifest(&self) -> String {
        String::from_utf8_lossy(&self.files[MANIFEST_FILE]).into_owned()
    }

    /// The manifest with the size and checksum of a changed file.
    pub(crate) fn repaired_manifest(&self, name: &str, changed: &[u8]) -> String {
        let old = &self.files[name];
        // The size is on the line before the checksum, which no other file has.
        let entry = |bytes: &[u8]| format!("bytes = {}\nsha256 = \"{}\"", bytes.len(), sha256_hex(bytes));
        self.manifest().replacen(&entry(old), &entry(changed), 1)
    }
}

/// Writes files into a folder.
pub(crate) fn write(folder: &Path, files: &Files) -> anyhow::Result<()> {
    for (name, bytes) in files {
        let path = folder.join(name);
        std::fs::write(&path, bytes).with_context(|| path.display().to_string())?;
    }
    Ok(())
}
