use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use ndarray::Axis;
use rcwm_models::episode::{EPISODE_BYTES_MAX, Episode};
use rcwm_models::files::{read_capped, sha256_hex};

use super::Replay;
use super::folder::{LoadError, is, name_of, sorted};
use super::masks::read_masks;

/// A folder of episodes, listed in a fixed order but not yet read.
#[derive(Debug, Clone)]
pub struct Folder {
    files: Vec<(String, PathBuf)>,
    masks: Option<PathBuf>,
    left_out: Vec<PathBuf>,
}

impl Folder {
    /// Lists `path`: one sub-folder a task, or the files right in it as the one task with the folder's name. `masks` is an
    /// optional folder of masks as pictures, `task/episode/*.png`; they replace those in the files.
    ///
    /// Where Dreamer's own programs wrote the folder it is read as they do: `train_eps` of a log folder or of a task's holds the
    /// episodes to learn from, and `eval_eps` those that nobody may learn from; they are left out unless they are named themselves.
    ///
    /// # Errors
    /// [`LoadError::Folder`], [`LoadError::NoEpisodes`] or [`LoadError::NoMasks`].
    pub fn list(path: &Path, masks: Option<&Path>) -> Result<Self, LoadError> {
        let mut found = Self { files: Vec::new(), masks: masks.map(Path::to_path_buf), left_out: Vec::new() };
        if path.is_file() {
            let source = io::Error::other("a file; expected the folder of episodes that holds it");
            return Err(LoadError::Folder { path: path.to_path_buf(), source });
        }
        let own = name_of(path);
        found.add(&own, path)?;
        for entry in sorted(path)?.into_iter().filter(|entry| entry.is_dir()) {
            let name = name_of(&entry);
            if is_train(&name) || is_evaluation(&name) {
                continue; // looked at as parts of the folder itself
            }
            found.add(&name, &entry)?;
        }
        if found.files.is_empty() {
            return Err(LoadError::NoEpisodes {
                path: path.to_path_buf(),
                deeper: search(path, SEARCH_DEPTH),
            });
        }
        found.check_masks()?;
        Ok(found)
    }

    /// Adds the episodes right in a folder, and those to train on that a run of Dreamer has put one folder further down.
    fn add(&mut self, task: &str, folder: &Path) -> Result<(), LoadError> {
        let mut files = files_in(folder)?;
        for entry in sorted(folder)?.into_iter().filter(|entry| entry.is_dir()) {
            let name = name_of(&entry);
            if is_train(&name) {
                files.extend(files_in(&entry)?);
            } else if is_evaluation(&name) && !self.left_out.contains(&entry) && !files_in(&entry)?.is_empty()
            {
                self.left_out.push(entry);
            }
        }
        self.files.extend(files.into_iter().map(|file| (task.to_owned(), file)));
        Ok(())
    }

    /// A folder of masks that is of no use is a mistake of whoever named it.
    fn check_masks(&self) -> Result<(), LoadError> {
        let Some(masks) = &self.masks else { return Ok(()) };
        let fail = |reason: String| Err(LoadError::NoMasks { path: masks.clone(), reason });
        if !masks.is_dir() {
            return fail("no such folder".into());
        }
        if self.with_mask_pictures() > 0 {
            return Ok(());
        }
        let Some((task, file)) = self.files.first() else { return Ok(()) };
        let looked_for = masks_of(masks, task, file);
        let flat = masks.join(file.file_stem().unwrap_or_default());
        let hint = if flat.is_dir() { "; the folder of the task is missing there" } else { "" };
        fail(format!("no masks of any episode; looked for {}{hint}", looked_for.display()))
    }

    /// Episodes whose masks are pictures.
    #[must_use]
    pub fn with_mask_pictures(&self) -> usize {
        let Some(masks) = &self.masks else { return 0 };
        self.files.iter().filter(|(task, file)| masks_of(masks, task, file).is_dir()).count()
    }

    /// What is to be told about the folder before it is used: what was left out, and which episodes have masks.
    #[must_use]
    pub fn notes(&self) -> Vec<String> {
        let left_out = self.left_out.iter().map(|folder| {
            format!(
                "left out: {} (episodes of evaluation); name the folder itself to use them",
                folder.display()
            )
        });
        let masks = self.masks.as_ref().map(|masks| {
            let (count, all) = (self.with_mask_pictures(), self.len());
            format!("{count} of {all} episodes have masks in {}", masks.display())
        });
        left_out.chain(masks).collect()
    }

    /// The same episodes, task by task.
    #[must_use]
    pub fn by_task(&self) -> Vec<(String, Self)> {
        let mut tasks: Vec<(String, Self)> = Vec::new();
        for (task, file) in &self.files {
            let entry = (task.clone(), file.clone());
            match tasks.iter_mut().find(|(name, _)| name == task) {
                Some((_, folder)) => folder.files.push(entry),
                None => tasks.push((
                    task.clone(),
                    Self { files: vec![entry], masks: self.masks.clone(), left_out: Vec::new() },
                )),
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
                if episode.image.len_of(Axis(3)) > 3 {
                    let reason = "masks of one camera, the episode has several; store `robot_mask`, `robot_mask_2` in it";
                    return Err(LoadError::Mask { path: folder, reason: reason.to_owned() });
                }
                episode.robot_mask = Some(read_masks(&folder, episode.len(), episode.side())?);
            }
        }
        Ok(episode)
    }

    /// Reads every episode into a replay; `seen` hears of each.
    pub fn load(&self, mut replay: Replay, mut seen: impl FnMut()) -> Result<Replay, LoadError> {
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

/// How far down is looked for episodes that were put elsewhere.
const SEARCH_DEPTH: usize = 3;

/// The folder of episodes to learn from in a log folder of dreamerv3-torch.
fn is_train(name: &str) -> bool {
    matches!(name, "train_eps" | "train_episodes")
}

/// Episodes that were recorded to judge by; to learn from them would spoil every number that is measured on them.
fn is_evaluation(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    let whole =
        ["eval", "evaluation", "test", "val", "valid", "validation", "holdout", "heldout", "held_out"];
    whole.contains(&name.as_str()) || name.starts_with("eval_") || name.starts_with("eval-")
}

/// The episodes right in a folder, in the order of their names.
fn files_in(folder: &Path) -> Result<Vec<PathBuf>, LoadError> {
    Ok(sorted(folder)?.into_iter().filter(|file| is(file, "npz") && !file.is_dir()).collect())
}

/// The first folder with episodes below `path`.
fn search(path: &Path, depth: usize) -> Option<PathBuf> {
    let below = sorted(path).ok()?;
    let folders: Vec<_> = below.into_iter().filter(|entry| entry.is_dir()).collect();
    let direct = folders.iter().find(|folder| files_in(folder).is_ok_and(|files| !files.is_empty()));
    let deeper = || folders.iter().filter(|_| depth > 0).find_map(|folder| search(folder, depth - 1));
    direct.cloned().or_else(deeper)
}

#[cfg(test)]
mod tests {
    use std::fs;

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
        let replay = listed.load(Replay::new(100), || seen += 1).unwrap();
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
        let load = || Folder::list(&data, Some(&masks)).unwrap().load(Replay::new(10), || ());
        assert!(matches!(load(), Err(LoadError::MaskCount { found: 1, expected: 2, .. })));
        image::GrayImage::new(64, 64).save(pictures.join("00001.png")).unwrap();
        let replay = load().unwrap();
        let mask = replay.tasks().next().unwrap().1[0].robot_mask.clone().unwrap();
        assert!(mask[[0, 3, 5]] && mask.iter().filter(|robot| **robot).count() == 1);
    }

    #[test]
    fn an_empty_folder_is_one_clear_error() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(Folder::list(folder.path(), None), Err(LoadError::NoEpisodes { deeper: None, .. })));
        let deep = folder.path().join("a/b/c");
        fs::create_dir_all(&deep).unwrap();
        episode(3, 1.0).write(&deep.join("1.npz")).unwrap();
        let error = Folder::list(folder.path(), None).unwrap_err().to_string();
        assert!(error.contains("a/b/c has some"), "{error}");
        let error = Folder::list(&deep.join("1.npz"), None).unwrap_err().to_string();
        assert!(error.contains("expected the folder"), "{error}");
    }

    fn put(path: &Path, reward: f32) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        episode(3, reward).write(path).unwrap();
    }

    fn rewards(folder: &Path) -> Vec<(String, Vec<f32>)> {
        let replay = Folder::list(folder, None).unwrap().load(Replay::new(1000), || ()).unwrap();
        let of = |(name, episodes): (&str, Vec<&std::sync::Arc<Episode>>)| {
            (name.to_owned(), episodes.iter().map(|episode| episode.reward[0]).collect())
        };
        replay.tasks().map(of).collect()
    }

    #[test]
    fn episodes_of_evaluation_are_left_out_and_told_unless_they_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let (log, base) = (folder.path().join("log"), folder.path().join("base"));
        for (place, reward) in [("train_eps", 1.0), ("eval_eps", 9.0), ("eval", 9.0)] {
            put(&log.join(place).join("1.npz"), reward);
            put(&base.join("hammer").join(place).join("1.npz"), reward);
        }
        assert_eq!(rewards(&log), [("log".to_owned(), vec![1.0])]);
        assert_eq!(rewards(&base), [("hammer".to_owned(), vec![1.0])]);
        let listed = Folder::list(&log, None).unwrap();
        assert_eq!(listed.notes().len(), 2, "{:?}", listed.notes());
        assert_eq!(Folder::list_task(&base, "hammer").unwrap().len(), 1);
        assert_eq!(rewards(&log.join("eval_eps")), [("eval_eps".to_owned(), vec![9.0])]);
    }

    #[test]
    fn links_are_read_and_hidden_files_are_not() {
        let folder = tempfile::tempdir().unwrap();
        put(&folder.path().join("store/one"), 4.0);
        let task = folder.path().join("snapshot/reach");
        fs::create_dir_all(&task).unwrap();
        std::os::unix::fs::symlink("../../store/one", task.join("a.npz")).unwrap();
        fs::write(task.join("._a.npz"), b"what macOS leaves").unwrap();
        assert_eq!(rewards(&folder.path().join("snapshot")), [("reach".to_owned(), vec![4.0])]);
        std::os::unix::fs::symlink("reach", folder.path().join("snapshot/again")).unwrap();
        assert_eq!(rewards(&folder.path().join("snapshot")).len(), 2, "a folder may be a link too");
    }

    #[test]
    fn a_folder_of_masks_that_matches_nothing_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let data = folder.path().join("data");
        put(&data.join("reach/a.npz"), 1.0);
        let refused = |masks: &Path| Folder::list(&data, Some(masks)).unwrap_err().to_string();
        let error = refused(&folder.path().join("maks"));
        assert!(error.contains("maks") && error.contains("no such folder"), "{error}");
        let flat = folder.path().join("flat");
        fs::create_dir_all(flat.join("a")).unwrap();
        let error = refused(&flat);
        assert!(error.contains("flat/reach/a") && error.contains("folder of the task is missing"), "{error}");
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
