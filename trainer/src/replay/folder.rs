//! What is in a folder of episodes or masks, and why it could not be loaded.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use rcwm_models::episode::EpisodeError;
use rcwm_models::files::FileError;

use super::ReplayError;

/// Why data could not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// A folder could not be listed.
    #[error("data: {path}: {source}")]
    Folder { path: PathBuf, source: io::Error },
    /// It holds no episodes.
    #[error(
        "data: {path} holds no .npz files, neither right there nor one folder down; {}",
        elsewhere(deeper)
    )]
    NoEpisodes {
        path: PathBuf,
        /// A folder further down that has some.
        deeper: Option<PathBuf>,
    },
    /// A folder of masks that does not exist, or has none of any episode.
    #[error("masks: {path}: {reason}")]
    NoMasks {
        path: PathBuf,
        /// What was found, and what was looked for.
        reason: String,
    },
    /// A file could not be read.
    #[error("data: {0}")]
    File(#[from] FileError),
    /// An episode's file is unusable.
    #[error("data: {0}")]
    Episode(#[from] EpisodeError),
    /// An episode was refused.
    #[error("data: {path}: {source}")]
    Refused { path: PathBuf, source: ReplayError },
    /// A mask is no readable picture, or it cannot be told what it shows.
    #[error("masks: {path}: {reason}")]
    Mask {
        /// The picture, or the folder of an episode's.
        path: PathBuf,
        reason: String,
    },
    /// There is not one mask for every step.
    #[error(
        "masks: {path} holds {found} pictures (.png), the episode has {expected} steps; it needs one for each"
    )]
    MaskCount {
        path: PathBuf,
        /// Pictures found.
        found: usize,
        /// Steps of the episode.
        expected: usize,
    },
}

fn elsewhere(deeper: &Option<PathBuf>) -> String {
    match deeper {
        Some(path) => format!("{} has some: name that folder, or put one folder a task", path.display()),
        None => "collect some first".to_owned(),
    }
}

/// What is in a folder, by name, without what is hidden: what a program writes at the moment, or what a system puts beside files.
pub(super) fn sorted(folder: &Path) -> Result<Vec<PathBuf>, LoadError> {
    let fail = |source| LoadError::Folder { path: folder.to_path_buf(), source };
    let entries = fs::read_dir(folder).map_err(fail)?;
    let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>().map_err(fail)?;
    paths.retain(|path| !name_of(path).starts_with('.'));
    paths.sort();
    Ok(paths)
}

pub(super) fn is(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

/// The folder's name, also where the path ends in `.` or `..`.
pub(super) fn name_of(path: &Path) -> String {
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
    name(path).or_else(|| name(&fs::canonicalize(path).ok()?)).unwrap_or_else(|| "data".to_owned())
}
