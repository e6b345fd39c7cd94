//! Room in shared memory, and whose it is. iceoryx2 maps files of which no byte is there yet: where `/dev/shm` is full, the first write
//! to such a page ends the process by SIGBUS. So room is asked for before, and taken for good as soon as the files are there.

use std::collections::BTreeSet;
use std::fs::{self, OpenOptions, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{Access, FallocateFlags, access, fallocate, statvfs};

use super::LinkError;

/// Where iceoryx2 keeps what is shared.
const SHARED_MEMORY: &str = "/dev/shm";
/// Payloads that a publisher keeps room for, and some more.
const PAYLOADS: u64 = 28;
/// Everything else that one end creates: some files of a page each.
const OVERHEAD_BYTES: u64 = 64 << 10;

/// Which shared memory this program sees, as a number: containers with memory of their own see another one.
#[must_use]
pub fn shared_memory_number() -> u64 {
    fs::metadata(SHARED_MEMORY).map_or(0, |meta| meta.dev())
}

/// Refuses a link whose sender's messages, of so many bytes each, find no room in shared memory.
pub(super) fn check_room(message_bytes: usize) -> Result<(), LinkError> {
    let needed = PAYLOADS * message_bytes as u64 + OVERHEAD_BYTES;
    // Where it cannot be told there may be room.
    let Ok(found) = statvfs(SHARED_MEMORY) else { return Ok(()) };
    let free = found.f_bavail.saturating_mul(found.f_frsize);
    if free < needed {
        Err(LinkError::Memory { free_kib: free >> 10, needed_kib: needed >> 10 })
    } else {
        Ok(())
    }
}

/// This user's files of a prefix in shared memory.
pub(super) fn files(prefix: &str) -> BTreeSet<PathBuf> {
    let own = rustix::process::geteuid().as_raw();
    let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    entries
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
        .filter(|entry| entry.metadata().is_ok_and(|meta| meta.is_file() && meta.uid() == own))
        .map(|entry| entry.path())
        .collect()
}

/// Takes the room of all files that were not there before, so that no later write can find none.
pub(super) fn reserve(prefix: &str, before: &BTreeSet<PathBuf>) -> Result<(), LinkError> {
    for path in files(prefix).difference(before) {
        // A peer may have removed its own meanwhile.
        let Ok(file) = OpenOptions::new().read(true).write(true).open(path) else { continue };
        let Ok(len) = file.metadata().map(|meta| meta.len()) else { continue };
        // A file system that cannot reserve is used as it is.
        if fallocate(&file, FallocateFlags::empty(), 0, len) == Err(rustix::io::Errno::NOSPC) {
            let free =
                statvfs(SHARED_MEMORY).map_or(0, |found| found.f_bavail.saturating_mul(found.f_frsize));
            return Err(LinkError::Memory { free_kib: free >> 10, needed_kib: len.div_ceil(1024) });
        }
    }
    Ok(())
}

/// Makes iceoryx2's folders under `root` with the rights of `/tmp`: every user may have files in them, and none may touch
/// another's. Those that iceoryx2 makes itself keep everybody out but the first user.
pub(super) fn open_folders(root: &Path) {
    for folder in [root.to_path_buf(), root.join("services"), root.join("nodes")] {
        // Where this fails iceoryx2 says what it makes of it, and `other_user` whose it is.
        let _ = fs::create_dir(&folder);
        let own = rustix::process::geteuid().as_raw();
        let ours = fs::symlink_metadata(&folder).is_ok_and(|meta| meta.is_dir() && meta.uid() == own);
        if ours {
            let _ = fs::set_permissions(&folder, Permissions::from_mode(0o1777));
        }
    }
}

/// What keeps this user out because it is another's: a folder that cannot be written, or files of the prefix.
pub(super) fn other_user(root: &Path, prefix: &str) -> Option<LinkError> {
    let folders = [root.to_path_buf(), root.join("services"), root.join("nodes")];
    let closed = |folder: &&PathBuf| {
        folder.is_dir() && access(folder.as_path(), Access::WRITE_OK | Access::EXEC_OK).is_err()
    };
    let blame = |path: &Path| {
        let owner = fs::symlink_metadata(path).map_or(0, |meta| meta.uid());
        (path.to_path_buf(), owner)
    };
    if let Some(folder) = folders.iter().find(closed) {
        let (path, owner) = blame(folder);
        return Some(LinkError::FolderOfOtherUser { path, owner, root: root.to_path_buf() });
    }
    let own = rustix::process::geteuid().as_raw();
    let all = std::iter::once(PathBuf::from(SHARED_MEMORY)).chain(folders);
    let files = all.filter_map(|folder| fs::read_dir(folder).ok()).flat_map(|entries| entries.flatten());
    files
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
        .map(|entry| blame(&entry.path()))
        .find(|(path, owner)| *owner != own && !path.to_string_lossy().ends_with(".global_mgmt"))
        .map(|(path, owner)| LinkError::FilesOfOtherUser { path, owner, prefix: prefix.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_that_finds_no_room_is_refused_with_both_sizes() {
        check_room(1000).unwrap();
        let error = check_room(1 << 50).unwrap_err();
        assert!(matches!(error, LinkError::Memory { free_kib, needed_kib } if free_kib < needed_kib));
        assert!(error.to_string().contains("--shm-size"), "{error}");
    }

    #[test]
    fn what_is_reserved_is_there() {
        let prefix = format!("rcwm_unit_{}_reserve_", std::process::id());
        let before = files(&prefix);
        let path = Path::new(SHARED_MEMORY).join(format!("{prefix}a"));
        let file = fs::File::create(&path).unwrap();
        file.set_len(1 << 20).unwrap();
        assert_eq!(file.metadata().unwrap().blocks(), 0);
        reserve(&prefix, &before).unwrap();
        let blocks = file.metadata().unwrap().blocks();
        fs::remove_file(&path).unwrap();
        assert_eq!(512 * blocks, 1 << 20);
    }

    #[test]
    fn folders_that_are_made_are_for_every_user() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("root");
        open_folders(&root);
        for made in [root.clone(), root.join("services"), root.join("nodes")] {
            assert_eq!(fs::metadata(&made).unwrap().mode() & 0o7777, 0o1777, "{}", made.display());
        }
        assert!(other_user(&root, "nothing-of-this-name").is_none());
    }
}
