//! A new file that grows while it is written, and is there as a whole or not at all.

use std::fs::{self, File, Permissions};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::{FileError, folder_of};

/// Written beside its path under a temporary name, which [`NewFile::keep`] exchanges for its own. Dropped before that, nothing is left.
#[derive(Debug)]
pub struct NewFile {
    path: PathBuf,
    temporary: NamedTempFile,
}

impl NewFile {
    /// Begins a file; its folder is made where it is missing.
    ///
    /// # Errors
    /// [`FileError::Exists`] or [`FileError::Io`].
    pub fn create(path: &Path) -> Result<Self, FileError> {
        if fs::symlink_metadata(path).is_ok() {
            return Err(FileError::Exists { path: path.to_path_buf() });
        }
        let folder = folder_of(path);
        fs::create_dir_all(&folder).map_err(FileError::io(&folder))?;
        Ok(Self { path: path.to_path_buf(), temporary: temporary(path)? })
    }

    /// Where it will be.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Brings what was written to the disk, and gives it its name.
    ///
    /// # Errors
    /// [`FileError::Exists`] where another program was faster, or [`FileError::Io`].
    pub fn keep(self) -> Result<(), FileError> {
        let Self { path, temporary } = self;
        temporary.as_file().sync_all().map_err(FileError::io(&path))?;
        temporary.persist_noclobber(&path).map_err(|error| match error.error.kind() {
            io::ErrorKind::AlreadyExists => FileError::Exists { path: path.clone() },
            _ => FileError::io(&path)(error.error),
        })?;
        sync(&folder_of(&path))
    }
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.temporary.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.temporary.flush()
    }
}

impl Seek for NewFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.temporary.seek(to)
    }
}

/// An empty temporary file beside `path`.
pub(super) fn temporary(path: &Path) -> Result<NamedTempFile, FileError> {
    // Readable for whom the umask lets read; temporary files are private to their owner by default.
    let mut builder = tempfile::Builder::new();
    let builder = builder.prefix(".writing-").permissions(Permissions::from_mode(0o666));
    builder.tempfile_in(folder_of(path)).map_err(FileError::io(path))
}

/// Brings the names in a folder to the disk.
pub(super) fn sync(folder: &Path) -> Result<(), FileError> {
    File::open(folder).and_then(|folder| folder.sync_all()).map_err(FileError::io(folder))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_kept_leaves_nothing_and_what_is_there_is_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/a.bin");
        let mut dropped = NewFile::create(&path).unwrap();
        dropped.write_all(b"half").unwrap();
        drop(dropped);
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 0);
        let [mut first, second] = [(); 2].map(|()| NewFile::create(&path).unwrap());
        first.write_all(b"whole").unwrap();
        first.keep().unwrap();
        assert!(matches!(second.keep(), Err(FileError::Exists { .. })), "the other was faster");
        assert!(matches!(NewFile::create(&path), Err(FileError::Exists { .. })));
        assert_eq!(fs::read(&path).unwrap(), b"whole");
    }
}
