//! A bundle's folder, built beside its place, opened and checked as a runtime would, and then put there in one step.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::MANIFEST_FILE;
use super::error::BundleError;
use super::load::Bundle;
use super::manifest::{FileEntry, Manifest};
use crate::files::{FileError, sha256_hex, write_atomic};

/// Why a bundle could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The place is taken.
    #[error("{path} is there already; choose another folder or say --force")]
    Exists { path: PathBuf },
    /// The place is taken by something that is no bundle, which is never replaced.
    #[error("{path} is there and is no bundle; choose another folder or remove it")]
    NotABundle { path: PathBuf },
    /// A folder could not be made, moved or removed.
    #[error("{path}: {source}")]
    Folder { path: PathBuf, source: io::Error },
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The manifest could not be written.
    #[error("the manifest: {0}")]
    Manifest(#[from] toml::ser::Error),
    /// The finished bundle does not open.
    #[error("the bundle would be refused: {0}")]
    Refused(#[from] BundleError),
}

/// A folder that is not at its place yet; it is removed again if it never gets there.
#[derive(Debug)]
pub struct NewBundle {
    building: tempfile::TempDir,
    place: PathBuf,
    replaces: bool,
}

impl NewBundle {
    /// Begins a bundle for `place`; `replace` says whether one that is there is replaced.
    ///
    /// # Errors
    /// [`WriteError::Exists`], [`WriteError::NotABundle`] or [`WriteError::Folder`].
    pub fn begin(place: &Path, replace: bool) -> Result<Self, WriteError> {
        let replaces = check_place(place, replace)?;
        let parent = parent_of(place);
        fs::create_dir_all(parent).map_err(folder_error(parent))?;
        let building = tempfile::Builder::new().prefix(".exporting-").tempdir_in(parent);
        let building = building.map_err(folder_error(parent))?;
        Ok(Self { building, place: place.to_path_buf(), replaces })
    }

    /// Writes a file; each is on the disk before the folder gets its name.
    ///
    /// # Errors
    /// [`WriteError::File`].
    pub fn file(&self, name: &str, bytes: &[u8]) -> Result<FileEntry, WriteError> {
        write_atomic(&self.building.path().join(name), bytes)?;
        Ok(FileEntry { file: name.to_owned(), bytes: bytes.len() as u64, sha256: sha256_hex(bytes) })
    }

    /// Writes the manifest and opens the folder as a runtime would.
    ///
    /// # Errors
    /// [`WriteError::Manifest`], [`WriteError::File`] or [`WriteError::Refused`].
    pub fn check(&self, manifest: &Manifest) -> Result<Bundle, WriteError> {
        self.file(MANIFEST_FILE, toml::to_string(manifest)?.as_bytes())?;
        Ok(Bundle::open(self.building.path())?)
    }

    /// Gives the finished folder its name in one step, so that whoever opens the place sees the old bundle or the new one.
    ///
    /// # Errors
    /// [`WriteError::Folder`] or [`WriteError::Refused`].
    pub fn finish(self) -> Result<Bundle, WriteError> {
        let Self { building, place, replaces } = self;
        let flags = if replaces { RenameFlags::EXCHANGE } else { RenameFlags::NOREPLACE };
        make_readable(building.path()).map_err(folder_error(&place))?;
        renameat_with(CWD, building.path(), CWD, &place, flags)
            .map_err(|errno| folder_error(&place)(errno.into()))?;
        let parent = parent_of(&place);
        File::open(parent).and_then(|folder| folder.sync_all()).map_err(folder_error(parent))?;
        if replaces {
            // The temporary folder now holds the old bundle.
            building.close().map_err(folder_error(&place))?;
        } else {
            let _moved = building.keep();
        }
        Ok(Bundle::open(&place)?)
    }
}

/// Whether there is a bundle to replace.
fn check_place(place: &Path, replace: bool) -> Result<bool, WriteError> {
    let path = place.to_path_buf();
    match fs::symlink_metadata(place) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(source) => Err(WriteError::Folder { path, source }),
        Ok(_) if !place.join(MANIFEST_FILE).is_file() => Err(WriteError::NotABundle { path }),
        Ok(_) if !replace => Err(WriteError::Exists { path }),
        Ok(_) => Ok(true),
    }
}

/// Temporary folders start private to their owner; a bundle is for everybody the place is for.
fn make_readable(folder: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(folder, fs::Permissions::from_mode(0o755))
}

fn parent_of(place: &Path) -> &Path {
    match place.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn folder_error(path: &Path) -> impl FnOnce(io::Error) -> WriteError {
    let path = path.to_path_buf();
    move |source| WriteError::Folder { path, source }
}
