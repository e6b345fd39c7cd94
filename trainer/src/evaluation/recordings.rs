use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use rcwm_models::episode::Episode;
use rcwm_models::settings::ModelSettings;

use crate::replay::{Folder, LoadError, ReplayError, check_episode};
use crate::simulators::Script;

/// The kind of episodes whose files are not called as `collect` calls them.
pub const OTHER_KIND: &str = "other";

/// An episode with robot masks, and who decided in it.
#[derive(Debug, Clone)]
pub struct Recording {
    /// `expert`, `mixed`, `random`, `pushed` or [`OTHER_KIND`].
    pub kind: &'static str,
    pub episode: Arc<Episode>,
}

/// Episodes with robot masks by task, in the order they came.
#[derive(Debug, Clone, Default)]
pub struct Recordings {
    tasks: BTreeMap<String, Vec<Recording>>,
}

impl Recordings {
    /// Reads those of a folder's episodes that have masks; `read` is called after each. All episodes must fit every one of `models`.
    pub fn load(
        folder: &Folder,
        models: &[&ModelSettings],
        mut read: impl FnMut(),
    ) -> Result<Self, LoadError> {
        let mut recordings = Self::default();
        for episode in folder.episodes() {
            let (task, path, episode) = episode?;
            let refused = |source| LoadError::Refused { path: path.to_path_buf(), source };
            if let Some(misfit) = models.iter().find_map(|model| episode.misfit(model)) {
                return Err(refused(ReplayError::Misfit { task: task.to_owned(), misfit }));
            }
            recordings.add(task, kind_of(path), episode).map_err(refused)?;
            read();
        }
        Ok(recordings)
    }

    /// Adds an episode; one without masks is left out.
    ///
    /// # Errors
    /// [`ReplayError`], if it has no steps or numbers that are not finite.
    pub fn add(&mut self, task: &str, kind: &'static str, episode: Episode) -> Result<(), ReplayError> {
        check_episode(task, &episode)?;
        if episode.robot_mask.is_some() {
            let recording = Recording { kind, episode: Arc::new(episode) };
            self.tasks.entry(task.to_owned()).or_default().push(recording);
        }
        Ok(())
    }

    /// Whether no episode has masks.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.tasks.is_empty()
    }

    /// The tasks by name.
    pub fn tasks(&self) -> impl Iterator<Item = (&str, &[Recording])> {
        self.tasks.iter().map(|(task, recordings)| (task.as_str(), recordings.as_slice()))
    }

    /// One task's.
    #[must_use]
    pub fn task(&self, task: &str) -> &[Recording] {
        self.tasks.get(task).map_or(&[], Vec::as_slice)
    }
}

/// The kind of an episode's file: `expert-seed0-00003.npz` is the expert's.
fn kind_of(path: &Path) -> &'static str {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let is = |script: &Script| name.strip_prefix(script.name()).is_some_and(|rest| rest.starts_with("-seed"));
    Script::ALL.into_iter().find(is).map_or(OTHER_KIND, Script::name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_file_says_who_decided() {
        for (name, kind) in [
            ("expert-seed900-00000.npz", "expert"),
            ("a/b/pushed-seed3-00010.npz", "pushed"),
            ("random-seed0-00000.npz", "random"),
            ("mixed-seed0-00000.npz", "mixed"),
            ("mixed.npz", OTHER_KIND),
            ("experts-seed0-00000.npz", OTHER_KIND),
            ("20240101T000000-1-251.npz", OTHER_KIND),
        ] {
            assert_eq!(kind_of(Path::new(name)), kind, "{name}");
        }
    }

    #[test]
    fn episodes_without_masks_are_left_out_and_bad_numbers_refused() {
        let mut recordings = Recordings::default();
        recordings.add("reach", OTHER_KIND, Episode::blank(3)).unwrap();
        assert!(recordings.is_empty());
        let masked = || Episode {
            robot_mask: Some(ndarray::Array3::from_elem((3, 64, 64), false)),
            ..Episode::blank(3)
        };
        recordings.add("reach", "expert", masked()).unwrap();
        assert_eq!((recordings.task("reach").len(), recordings.task("hammer").len()), (1, 0));
        let mut poisoned = masked();
        poisoned.action[[1, 0]] = f32::INFINITY;
        assert!(matches!(recordings.add("reach", "expert", poisoned), Err(ReplayError::NotFinite { .. })));
    }
}
