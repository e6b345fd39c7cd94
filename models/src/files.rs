//! Files as a deployed system needs them: written atomically, read with a limit, checked by sha256.

mod new;

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

pub use new::NewFile;

use rustix::fs::OFlags;
use sha2::{Digest, Sha256};

/// Why a file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file could not be opened, read, written or renamed.
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: io::Error },
    /// The file is larger than this kind of file may be.
    #[error("{path} holds {found} bytes, at most {limit} are accepted for this kind of file")]
    TooLarge {
        path: PathBuf,
        /// Its size in bytes.
        found: u64,
        /// The largest size accepted, in bytes.
        limit: u64,
    },
    /// The path names something that is not a plain file.
    #[error("{path} is not a plain file (it is a folder, a device or a pipe)")]
    NotAFile { path: PathBuf },
    /// The file that is to be replaced is of another kind.
    #[error("{path} holds something else than {expected}, which would be lost; choose another file")]
    OtherKind {
        path: PathBuf,
        /// What is to be written.
        expected: Output,
    },
    /// The file is there and must not be written over.
    #[error("{path} exists already and is not written over; remove it, or choose another place")]
    Exists { path: PathBuf },
}

/// What a verb writes where it is told to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Output {
    /// A result as JSON.
    Json,
    /// A picture as PNG.
    Png,
}

impl std::fmt::Display for Output {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Json => "JSON",
            Self::Png => "a PNG picture",
        })
    }
}

impl Output {
    /// Whether a file that begins like this may be one.
    fn is_like(self, begin: &[u8]) -> bool {
        match self {
            Self::Json => matches!(begin.trim_ascii_start().first(), None | Some(b'{' | b'[')),
            Self::Png => begin.is_empty() || begin.starts_with(b"\x89PNG"),
        }
    }
}

impl FileError {
    fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { path, source }
    }
}

/// Opens a plain file of at most `bytes_max` bytes, and says how many it has. See [`read_capped`].
///
/// # Errors
/// [`FileError::NotAFile`], [`FileError::TooLarge`] or [`FileError::Io`].
pub fn open_capped(path: &Path, bytes_max: u64) -> Result<(File, u64), FileError> {
    let without_waiting = OFlags::NONBLOCK.bits() as i32;
    let open = OpenOptions::new().read(true).custom_flags(without_waiting).open(path);
    let file = open.map_err(FileError::io(path))?;
    let meta = file.metadata().map_err(FileError::io(path))?;
    if !meta.is_file() {
        return Err(FileError::NotAFile { path: path.to_path_buf() });
    }
    let found = meta.len();
    if found > bytes_max {
        return Err(FileError::TooLarge { path: path.to_path_buf(), found, limit: bytes_max });
    }
    Ok((file, found))
}

/// Reads a whole plain file of at most `bytes_max` bytes. Links are followed: data are often links into a store of large files.
///
/// What is checked is what is read: a link that is turned elsewhere meanwhile changes nothing. A pipe is refused, not waited for.
///
/// # Errors
/// [`FileError::NotAFile`], [`FileError::TooLarge`] before anything is read, or [`FileError::Io`].
pub fn read_capped(path: &Path, bytes_max: u64) -> Result<Vec<u8>, FileError> {
    let (file, found) = open_capped(path, bytes_max)?;
    let mut bytes = Vec::with_capacity(found as usize);
    // The file may grow between the check and the read: the reader is limited as well.
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(FileError::io(path))?;
    if bytes.len() as u64 > bytes_max {
        let found = bytes.len() as u64;
        return Err(FileError::TooLarge { path: path.to_path_buf(), found, limit: bytes_max });
    }
    Ok(bytes)
}

/// Writes `bytes` so that a reader sees the old file or the whole new one, also after a crash:
/// temporary file in the same folder, fsync, rename, fsync of the folder. Where the path is a link, what it leads to is replaced; a
/// device or a pipe (`/dev/stdout`) is written to.
///
/// # Errors
/// [`FileError::Io`]; the old file is then untouched. [`FileError::NotAFile`] where the path is a folder.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    match fs::metadata(path) {
        Ok(meta) if meta.is_dir() => Err(FileError::NotAFile { path: path.to_path_buf() }),
        Ok(meta) if !meta.is_file() => OpenOptions::new()
            .write(true)
            .open(path)
            .and_then(|mut file| file.write_all(bytes))
            .map_err(FileError::io(path)),
        Ok(_) => {
            let path = fs::canonicalize(path).map_err(FileError::io(path))?;
            let (temporary, folder) = written(&path, bytes)?;
            temporary.persist(&path).map_err(|error| FileError::io(&path)(error.error))?;
            new::sync(&folder)
        }
        Err(_) => {
            let (temporary, folder) = written(path, bytes)?;
            temporary.persist(path).map_err(|error| FileError::io(path)(error.error))?;
            new::sync(&folder)
        }
    }
}

/// The same of a new file: one that is there stays as it is, also where two programs write it at a time.
///
/// # Errors
/// [`FileError::Exists`] or [`FileError::Io`].
pub fn write_new(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let mut file = NewFile::create(path)?;
    file.write_all(bytes).map_err(FileError::io(path))?;
    file.keep()
}

/// A temporary file beside `path` that holds `bytes` on the disk, and its folder.
fn written(path: &Path, bytes: &[u8]) -> Result<(tempfile::NamedTempFile, PathBuf), FileError> {
    let mut temporary = new::temporary(path)?;
    temporary.write_all(bytes).map_err(FileError::io(path))?;
    temporary.as_file().sync_all().map_err(FileError::io(path))?;
    Ok((temporary, folder_of(path)))
}

fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

/// Makes sure, before long work begins, that a file can be written there when it is done: its folder is made where it is missing, and a
/// path that is a folder, or where nothing can be written, is an error now. An older result may be replaced, a file of another kind may
/// not. `-` is standard output, which is kept for it from now on.
///
/// # Errors
/// [`FileError::NotAFile`], [`FileError::OtherKind`] or [`FileError::Io`].
pub fn prepare_output(path: &Path, output: Output) -> Result<(), FileError> {
    if path == Path::new("-") {
        crate::terminal::keep_for_result();
        return Ok(());
    }
    match fs::metadata(path) {
        Ok(meta) if meta.is_dir() => return Err(FileError::NotAFile { path: path.to_path_buf() }),
        Ok(meta) if !meta.is_file() => return Ok(()),
        _ => {}
    }
    let path = fs::canonicalize(path).unwrap_or_else(|_| path.to_path_buf());
    if let Ok(file) = File::open(&path) {
        let mut begin = Vec::new();
        file.take(64).read_to_end(&mut begin).map_err(FileError::io(&path))?;
        if !output.is_like(&begin) {
            return Err(FileError::OtherKind { path, expected: output });
        }
    }
    let folder = folder_of(&path);
    fs::create_dir_all(&folder).map_err(FileError::io(&folder))?;
    tempfile::Builder::new().prefix(".writing-").tempfile_in(&folder).map(drop).map_err(FileError::io(&path))
}

/// Writes what [`prepare_output`] has prepared: atomically to a file, or to standard output.
///
/// # Errors
/// [`FileError::Io`].
pub fn write_output(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    if path == Path::new("-") {
        return crate::terminal::print_result(bytes).map_err(FileError::io(Path::new("standard output")));
    }
    write_atomic(path, bytes)
}

/// The first of `name.ext`, `name-2.ext`, `name-3.ext`, ... for which `is_free` holds.
pub fn free_name(path: &Path, mut is_free: impl FnMut(&Path) -> bool) -> PathBuf {
    let numbered = |number: u64| {
        if number == 1 {
            return path.to_path_buf();
        }
        let mut name: OsString = path.file_stem().unwrap_or_default().to_owned();
        name.push(format!("-{number}"));
        if let Some(extension) = path.extension() {
            name.push(".");
            name.push(extension);
        }
        path.with_file_name(name)
    };
    (1..).map(numbered).find(|path| is_free(path)).unwrap_or_else(|| path.to_path_buf())
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
    use std::os::unix::fs::{MetadataExt, symlink};

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
    fn a_link_is_read_with_the_limit_of_what_it_leads_to() {
        let folder = tempfile::tempdir().unwrap();
        let (path, link) = (folder.path().join("a.bin"), folder.path().join("link"));
        write_atomic(&path, &[0; 10]).unwrap();
        symlink("a.bin", &link).unwrap();
        for name in [&path, &link] {
            assert_eq!(read_capped(name, 10).unwrap(), [0; 10]);
            assert!(matches!(read_capped(name, 9), Err(FileError::TooLarge { found: 10, limit: 9, .. })));
        }
    }

    #[test]
    fn folders_devices_and_pipes_are_refused_at_once_also_behind_a_link() {
        let folder = tempfile::tempdir().unwrap();
        let (pipe, link) = (folder.path().join("pipe"), folder.path().join("link"));
        rustix::fs::mknodat(
            rustix::fs::CWD,
            &pipe,
            rustix::fs::FileType::Fifo,
            rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR,
            0,
        )
        .unwrap();
        symlink(&pipe, &link).unwrap();
        for path in [folder.path(), &pipe, &link, "/dev/zero".as_ref()] {
            assert!(matches!(read_capped(path, 100), Err(FileError::NotAFile { .. })), "{}", path.display());
        }
    }

    #[test]
    fn a_link_is_kept_and_what_it_leads_to_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let (path, link) = (folder.path().join("a.bin"), folder.path().join("link"));
        write_atomic(&path, b"old").unwrap();
        symlink("a.bin", &link).unwrap();
        write_atomic(&link, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    }

    #[test]
    fn a_device_is_written_to_and_stays_one() {
        let before = fs::metadata("/dev/null").unwrap();
        write_atomic("/dev/null".as_ref(), b"gone").unwrap();
        let after = fs::metadata("/dev/null").unwrap();
        assert_eq!((before.file_type(), before.ino()), (after.file_type(), after.ino()));
        assert!(write_atomic("/dev/full".as_ref(), b"lost").is_err(), "what cannot be written is an error");
    }

    #[test]
    fn a_new_file_never_replaces_one_that_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_new(&path, b"first").unwrap();
        assert!(matches!(write_new(&path, b"second"), Err(FileError::Exists { .. })));
        assert_eq!(fs::read(&path).unwrap(), b"first");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn an_output_is_found_unwritable_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("not/yet/there/a.json");
        prepare_output(&path, Output::Json).unwrap();
        write_atomic(&path, b"{}").unwrap();
        prepare_output(&path, Output::Json).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"{}", "what is there is not touched");
        let json = |path: &Path| prepare_output(path, Output::Json);
        assert!(matches!(json(folder.path()), Err(FileError::NotAFile { .. })));
        let error = json(&path.join("below/a.json")).unwrap_err().to_string();
        assert!(error.contains("a.json"), "{error}");
        json("/dev/null".as_ref()).unwrap();
    }

    #[test]
    fn a_result_never_replaces_a_file_of_another_kind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("manifest.toml");
        write_atomic(&path, b"format = 1").unwrap();
        for output in [Output::Json, Output::Png] {
            let error = prepare_output(&path, output).unwrap_err();
            assert!(matches!(error, FileError::OtherKind { .. }), "{error}");
        }
        write_atomic(&path, b"\x89PNG\r\n").unwrap();
        prepare_output(&path, Output::Png).unwrap();
        assert!(prepare_output(&path, Output::Json).is_err());
    }

    #[test]
    fn names_that_are_taken_are_numbered() {
        let taken = ["a/log.x", "a/log-2.x"];
        let free = |path: &str| free_name(path.as_ref(), |name| !taken.contains(&name.to_str().unwrap()));
        assert_eq!(free("a/log.x"), Path::new("a/log-3.x"));
        assert_eq!(free("a/other"), Path::new("a/other"));
    }

    #[test]
    fn sha256_of_the_empty_input_is_the_published_one() {
        assert_eq!(sha256_hex(b""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    }
}
