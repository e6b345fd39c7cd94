use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use ndarray::Array3;
use rcwm_models::IMAGE_SIDE;
use rcwm_models::episode::{EPISODE_BYTES_MAX, Episode, EpisodeError};
use rcwm_models::files::{FileError, read_capped, sha256_hex};

use super::{Replay, ReplayError};

/// Why data could not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// A folder could not be listed.
    #[error("data: {path}: {source}")]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// It holds no episodes.
    #[error("data: {path} holds no .npz files, neither right there nor one folder down; collect some first")]
    NoEpisodes {
        /// The folder.
        path: PathBuf,
    },
    /// A file could not be read.
    #[error("data: {0}")]
    File(#[from] FileError),
    /// An episode's file is unusable.
    #[error("data: {0}")]
    Episode(#[from] EpisodeError),
    /// An episode was refused.
    #[error("data: {path}: {source}")]
    Refused {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ReplayError,
    },
    /// A mask is no readable picture.
    #[error("masks: {path}: {reason}")]
    Mask {
        /// The picture.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// There is not one mask for every step.
    #[error("masks: {path} holds {found} pictures, the episode has {expected} steps; it needs one for each")]
    MaskCount {
        /// The folder.
        path: PathBuf,
        /// Pictures found.
        found: usize,
        /// Steps of the episode.
        expected: usize,
    },
}

/// A folder of episodes, listed in a fixed order but not yet read.
#[derive(Debug, Clone)]
pub struct Folder {
    files: Vec<(String, PathBuf)>,
    masks: Option<PathBuf>,
}

impl Folder {
    /// Lists `path`: one sub-folder a task, or the files right in it as the one task with the folder's name. `masks` is an
    /// optional folder of masks as pictures, `task/episode/*.png`; they replace those in the files.
    ///
    /// # Errors
    /// [`LoadError::Folder`] or [`LoadError::NoEpisodes`].
    pub fn list(path: &Path, masks: Option<&Path>) -> Result<Self, LoadError> {
        let mut files = Vec::new();
        let own = name_of(path);
        for entry in sorted(path)? {
            if entry.is_dir() {
                let task = name_of(&entry);
                files.extend(
                    sorted(&entry)?
                        .into_iter()
                        .filter(|file| is(file, "npz"))
                        .map(|file| (task.clone(), file)),
                );
            } else if is(&entry, "npz") {
                files.push((own.clone(), entry));
            }
        }
        if files.is_empty() {
            return Err(LoadError::NoEpisodes { path: path.to_path_buf() });
        }
        Ok(Self { files, masks: masks.map(Path::to_path_buf) })
    }

    /// The same episodes, task by task.
    #[must_use]
    pub fn by_task(&self) -> Vec<(String, Self)> {
        let mut tasks: Vec<(String, Self)> = Vec::new();
        for (task, file) in &self.files {
            let entry = (task.clone(), file.clone());
            match tasks.iter_mut().find(|(name, _)| name == task) {
                Some((_, folder)) => folder.files.push(entry),
                None => tasks.push((task.clone(), Self { files: vec![entry], masks: self.masks.clone() })),
            }
        }
        tasks
    }

    /// One checksum of all episodes: of the names and contents of their files, and of their masks where these are pictures.
    ///
    /// # Errors
    /// [`LoadError::Folder`] or [`LoadError::File`].
    pub fn sha256(&self) -> Result<String, LoadError> {
        let mut sums = String::new();
        let mut add = |path: &Path| -> Result<(), LoadError> {
            let bytes = read_capped(path, EPISODE_BYTES_MAX)?;
            let _ = writeln!(sums, "{} {}", sha256_hex(&bytes), name_of(path));
            Ok(())
        };
        for (task, path) in &self.files {
            add(path)?;
            let folder = self.masks.as_ref().map(|masks| masks_of(masks, task, path));
            for picture in folder
                .filter(|folder| folder.is_dir())
                .map(|folder| sorted(&folder))
                .transpose()?
                .iter()
                .flatten()
            {
                add(picture)?;
            }
        }
        Ok(sha256_hex(sums.as_bytes()))
    }

    /// Number of episodes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.files.len()
    }

    /// Whether there are none; never so after [`Folder::list`].
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// Lists the episodes of one task: those in `path/task` if there is such a folder, else all that is in `path`.
    ///
    /// # Errors
    /// [`LoadError::Folder`] or [`LoadError::NoEpisodes`].
    pub fn list_task(path: &Path, task: &str) -> Result<Self, LoadError> {
        let own = path.join(task);
        Self::list(if !task.is_empty() && own.is_dir() { &own } else { path }, None)
    }

    /// Reads the episodes one by one, in order, with their tasks and files.
    pub fn episodes(&self) -> impl Iterator<Item = Result<(&str, &Path, Episode), LoadError>> {
        self.files.iter().map(|(task, path)| Ok((task.as_str(), path.as_path(), self.read(task, path)?)))
    }

    fn read(&self, task: &str, path: &Path) -> Result<Episode, LoadError> {
        let mut episode = Episode::read(path)?;
        if let Some(masks) = &self.masks {
            let folder = masks_of(masks, task, path);
            if folder.is_dir() {
                episode.robot_mask = Some(read_masks(&folder, episode.len())?);
            }
        }
        Ok(episode)
    }

    /// Reads every episode into a replay of this capacity in steps; `seen` hears of each.
    ///
    /// # Errors
    /// See [`LoadError`].
    pub fn load(&self, capacity: usize, mut seen: impl FnMut()) -> Result<Replay, LoadError> {
        let mut replay = Replay::new(capacity);
        for read in self.episodes() {
            let (task, path, episode) = read?;
            let refused = |source| LoadError::Refused { path: path.to_path_buf(), source };
            replay.add(task, episode).map_err(refused)?;
            seen();
        }
        Ok(replay)
    }
}

/// Where the masks of an episode's file are, if they are pictures.
fn masks_of(masks: &Path, task: &str, path: &Path) -> PathBuf {
    masks.join(task).join(path.file_stem().unwrap_or_default())
}

fn sorted(folder: &Path) -> Result<Vec<PathBuf>, LoadError> {
    let fail = |source| LoadError::Folder { path: folder.to_path_buf(), source };
    let entries = fs::read_dir(folder).map_err(fail)?;
    let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>().map_err(fail)?;
    paths.sort();
    Ok(paths)
}

fn is(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

fn name_of(path: &Path) -> String {
    path.file_name().map_or_else(|| "data".to_owned(), |name| name.to_string_lossy().into_owned())
}

/// Reads one picture a step, in the order of their names; brighter than half is the robot.
fn read_masks(folder: &Path, steps: usize) -> Result<Array3<bool>, LoadError> {
    let pictures: Vec<_> = sorted(folder)?.into_iter().filter(|file| is(file, "png")).collect();
    if pictures.len() != steps {
        let (path, found) = (folder.to_path_buf(), pictures.len());
        return Err(LoadError::MaskCount { path, found, expected: steps });
    }
    let mut masks = Array3::from_elem((steps, IMAGE_SIDE, IMAGE_SIDE), false);
    for (mut mask, path) in masks.outer_iter_mut().zip(&pictures) {
        let fail = |reason: String| LoadError::Mask { path: path.clone(), reason };
        let picture = image::open(path).map_err(|error| fail(error.to_string()))?.into_luma8();
        let side = IMAGE_SIDE as u32;
        if picture.dimensions() != (side, side) {
            let (width, height) = picture.dimensions();
            return Err(fail(format!("is {width}x{height} pixels, expected {side}x{side}")));
        }
        for (robot, pixel) in mask.iter_mut().zip(picture.pixels()) {
            *robot = pixel.0[0] > 127;
        }
    }
    Ok(masks)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array1;

    fn episode(steps: usize, reward: f32) -> Episode {
        Episode { reward: Array1::from_elem(steps, reward), ..Episode::blank(steps) }
    }

    #[test]
    fn a_folder_a_task_is_loaded_in_the_order_of_names() {
        let folder = tempfile::tempdir().unwrap();
        for (task, name, reward) in [("reach", "b", 2.0), ("reach", "a", 1.0), ("hammer", "c", 3.0)] {
            fs::create_dir_all(folder.path().join(task)).unwrap();
            episode(3, reward).write(&folder.path().join(task).join(name).with_extension("npz")).unwrap();
        }
        let listed = Folder::list(folder.path(), None).unwrap();
        let mut seen = 0;
        let replay = listed.load(100, || seen += 1).unwrap();
        let found: Vec<_> = replay
            .tasks()
            .map(|(name, episodes)| (name, episodes.iter().map(|e| e.reward[0]).collect::<Vec<_>>()))
            .collect();
        assert_eq!(found, [("hammer", vec![3.0]), ("reach", vec![1.0, 2.0])]);
        assert_eq!(seen, 3);
    }

    #[test]
    fn masks_come_from_pictures_one_a_step() {
        let folder = tempfile::tempdir().unwrap();
        let masks = folder.path().join("masks");
        let data = folder.path().join("data");
        let pictures = masks.join("data").join("a");
        fs::create_dir_all(&pictures).unwrap();
        fs::create_dir_all(&data).unwrap();
        episode(2, 0.0).write(&data.join("a.npz")).unwrap();
        let mut picture = image::GrayImage::new(64, 64);
        picture.put_pixel(5, 3, image::Luma([255]));
        picture.save(pictures.join("00000.png")).unwrap();
        let load = || Folder::list(&data, Some(&masks)).unwrap().load(10, || ());
        assert!(matches!(load(), Err(LoadError::MaskCount { found: 1, expected: 2, .. })));
        image::GrayImage::new(64, 64).save(pictures.join("00001.png")).unwrap();
        let replay = load().unwrap();
        let mask = replay.tasks().next().unwrap().1[0].robot_mask.clone().unwrap();
        assert!(mask[[0, 3, 5]] && mask.iter().filter(|robot| **robot).count() == 1);
    }

    #[test]
    fn an_empty_folder_is_one_clear_error() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(Folder::list(folder.path(), None), Err(LoadError::NoEpisodes { .. })));
    }

    #[test]
    fn a_checksum_is_of_one_task_and_changes_with_its_episodes() {
        let folder = tempfile::tempdir().unwrap();
        let write = |task: &str, name: &str| {
            fs::create_dir_all(folder.path().join(task)).unwrap();
            episode(3, 1.0).write(&folder.path().join(task).join(name)).unwrap();
        };
        let sums = || -> Vec<(String, String)> {
            let tasks = Folder::list(folder.path(), None).unwrap().by_task();
            tasks.into_iter().map(|(task, folder)| (task, folder.sha256().unwrap())).collect()
        };
        write("hammer", "a.npz");
        write("reach", "a.npz");
        let before = sums();
        assert_eq!((before.len(), before[0].0.as_str()), (2, "hammer"));
        assert_eq!(sums(), before);
        write("reach", "b.npz");
        let after = sums();
        assert_eq!(after[0], before[0], "the other task is as it was");
        assert_ne!(after[1].1, before[1].1);
    }
}
