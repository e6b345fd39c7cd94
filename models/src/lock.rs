//! One writer a folder: a second program that wants to write where one writes already is refused.

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// A folder, or a file, that nobody else writes while this is held. The system frees it when the process ends, however it ends.
#[derive(Debug)]
pub struct Lock {
    _file: File,
}

/// Why there is no lock.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Somebody else has it.
    #[error("{path} is in use: {}; wait for it to end, stop it, or choose another place", owner(*pid))]
    InUse {
        /// What was to be locked.
        path: PathBuf,
        /// The process that has it, where the system tells.
        pid: Option<u32>,
    },
    /// It could not be opened.
    #[error("{path}: {source}")]
    Io {
        /// What was to be locked.
        path: PathBuf,
        source: io::Error,
    },
}

fn owner(pid: Option<u32>) -> String {
    match pid {
        Some(pid) => format!("process {pid} writes there"),
        None => "another program writes there".to_owned(),
    }
}

impl Lock {
    /// Takes a folder or file, which must exist, without waiting. File systems that know no locks give one that keeps nobody out.
    ///
    /// # Errors
    /// [`LockError::InUse`] or [`LockError::Io`].
    pub fn take(path: &Path) -> Result<Self, LockError> {
        let file = File::open(path).map_err(|source| LockError::Io { path: path.to_path_buf(), source })?;
        match file.try_lock() {
            Ok(()) | Err(TryLockError::Error(_)) => Ok(Self { _file: file }),
            Err(TryLockError::WouldBlock) => {
                Err(LockError::InUse { path: path.to_path_buf(), pid: holder(&file) })
            }
        }
    }
}

/// The process that holds the lock, by the system's list of them.
fn holder(file: &File) -> Option<u32> {
    let inode = format!(":{}", file.metadata().ok()?.ino());
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    // 1: FLOCK  ADVISORY  WRITE 4711 fe:00:131074 0 EOF
    let mut held = locks.lines().filter(|line| line.contains("FLOCK") && !line.contains("->"));
    held.find_map(|line| {
        let mut words = line.split_whitespace().skip(4);
        let (pid, place) = (words.next()?, words.next()?);
        place.ends_with(&inode).then(|| pid.parse().ok()).flatten()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_writer_is_refused_and_told_who_is_first() {
        let folder = tempfile::tempdir().unwrap();
        let first = Lock::take(folder.path()).unwrap();
        let error = Lock::take(folder.path()).unwrap_err();
        assert!(matches!(&error, LockError::InUse { .. }), "{error}");
        assert!(error.to_string().contains("is in use"), "{error}");
        drop(first);
        Lock::take(folder.path()).unwrap();
        assert!(matches!(Lock::take(&folder.path().join("none")), Err(LockError::Io { .. })));
    }
}
