use std::path::Path;

use super::TrainingError;
use crate::replay::{Folder, LoadError, Replay};

/// The first `count` successful episodes in the folder of a task's episodes, in the order of their names: `collect` names those of the
/// scripted expert so that they come first.
///
/// # Errors
/// [`TrainingError::NoDemonstrations`] if there is none, or those of reading.
pub fn demonstrations(
    data: &Path,
    task: &str,
    count: usize,
    capacity_steps: usize,
    mut seen: impl FnMut(),
) -> Result<Replay, TrainingError> {
    let mut replay = Replay::new(capacity_steps);
    let mut episodes = 0;
    for read in Folder::list_task(data, task)?.episodes() {
        let (name, path, episode) = read?;
        episodes += 1;
        if episode.succeeded() {
            let refused = |source| LoadError::Refused { path: path.to_path_buf(), source };
            replay.add(name, episode).map_err(refused)?;
            seen();
        }
        if replay.episodes() == count {
            break;
        }
    }
    if replay.episodes() == 0 {
        let task = if task.is_empty() { "any task" } else { task };
        return Err(TrainingError::NoDemonstrations {
            path: data.to_path_buf(),
            task: task.to_owned(),
            episodes,
        });
    }
    Ok(replay)
}
