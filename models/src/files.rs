//! Files as a deployed system needs them: written atomically, read with a limit, checked by sha256.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

/// Why a file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file could not be opened, read, written or renamed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// The file is larger than this kind of file may be.
    #[error("{path} holds {found} bytes, at most {limit} are accepted for this kind of file")]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size in bytes.
        found: u64,
        /// The largest size accepted, in bytes.
        limit: u64,
    },
    /// The path names something that is not a plain file.
    #[error("{path} is not a plain file (a link, a folder or a device is not accepted here)")]
    NotAFile {
        /// The path.
        path: PathBuf,
    },
}

impl FileError {
    fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { path, source }
    }
}

/// Reads a whole plain file of at most `bytes_max` bytes; links are not followed.
///
/// # Errors
/// [`FileError::NotAFile`], [`FileError::TooLarge`] before anything is read, or [`FileError::Io`].
pub fn read_capped(path: &Path, bytes_max: u64) -> Result<Vec<u8>, FileError> {
    let meta = fs::symlink_metadata(path).map_err(FileError::io(path))?;
    if !meta.is_file() {
        return Err(FileError::NotAFile { path: path.to_path_buf() });
    }
    let too_large = |found| FileError::TooLarge { path: path.to_path_buf(), found, limit: bytes_max };
    if meta.len() > bytes_max {
        return Err(too_large(meta.len()));
    }
    let mut bytes = Vec::with_capacity(meta.len() as usize);
    let file = File::open(path).map_err(FileError::io(path))?;
    // The file may grow between the check and the read: the reader is limited as well.
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(FileError::io(path))?;
    if bytes.len() as u64 > bytes_max {
        return Err(too_large(bytes.len() as u64));
    }
    Ok(bytes)
}

/// Writes `bytes` so that a reader sees the old file or the whole new one, also after a crash:
/// temporary file in the same folder, fsync, rename, fsync of the folder.
///
/// # Errors
/// [`FileError::Io`]; the old file is then untouched.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let mut temporary =
        tempfile::Builder::new().prefix(".writing-").tempfile_in(folder).map_err(FileError::io(path))?;
    temporary.write_all(bytes).map_err(FileError::io(path))?;
    make_readable(temporary.as_file()).map_err(FileError::io(path))?;
    temporary.as_file().sync_all().map_err(FileError::io(path))?;
    temporary
        .persist(path)
        .map_err(|error| FileError::Io { path: path.to_path_buf(), source: error.error })?;
    File::open(folder).and_then(|folder| folder.sync_all()).map_err(FileError::io(folder))
}

/// Temporary files start private to their owner; results are for everybody the folder is for.
fn make_readable(file: &File) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    file.set_permissions(fs::Permissions::from_mode(0o644))
}

/// Lower-case hexadecimal sha256 of `bytes`.
#[must_use]
pub fn sha256_hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    Sha256::digest(bytes).iter().fold(String::with_capacity(64), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_written_atomically_reads_back_and_leaves_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_atomic(&path, b"one").unwrap();
        write_atomic(&path, b"three").unwrap();
        assert_eq!(read_capped(&path, 5).unwrap(), b"three");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_file_over_the_limit_and_a_link_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_atomic(&path, &[0; 10]).unwrap();
        assert!(matches!(read_capped(&path, 9), Err(FileError::TooLarge { found: 10, limit: 9, .. })));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        assert!(matches!(read_capped(&link, 100), Err(FileError::NotAFile { .. })));
    }

    #[test]
    fn sha256_of_the_empty_input_is_the_published_one() {
        assert_eq!(sha256_hex(b""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    }
}
