use std::path::Path;

use rcwm_models::episode::Episode;

use super::{FewshotSettings, TrainingError};
use crate::replay::{Folder, LoadError, Replay};

/// The first demonstrations in the folder of a task's episodes that the settings ask for, in the order of their names: `collect` names
/// those of the scripted expert so that they come first. They are added to an empty `replay`.
///
/// # Errors
/// [`TrainingError::NoDemonstrations`] if there is none, or those of reading.
pub fn demonstrations(
    data: &Path,
    task: &str,
    settings: &FewshotSettings,
    mut replay: Replay,
    mut seen: impl FnMut(),
) -> Result<Replay, TrainingError> {
    let mut episodes = 0;
    for read in Folder::list_task(data, task)?.episodes() {
        let (name, path, episode) = read?;
        episodes += 1;
        if episode.succeeded() {
            let refused = |source| LoadError::Refused { path: path.to_path_buf(), source };
            replay.add(name, cut(episode, settings.steps_after_success)).map_err(refused)?;
            seen();
        }
        if replay.episodes() == settings.demonstrations {
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

/// The episode up to so many steps after its first success.
fn cut(episode: Episode, steps_after_success: usize) -> Episode {
    match episode.success.iter().position(|success| *success) {
        Some(first) => episode.shortened(first.saturating_add(steps_after_success).saturating_add(1)),
        None => episode,
    }
}
