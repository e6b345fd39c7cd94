use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use rcwm_models::episode::Episode;

use super::{FinetuneSettings, TrainingError, TrainingSettings};
use crate::replay::{Folder, LoadError, Replay};
use crate::simulators::{Amounts, CollectSettings, Plan, Progress, Script, collect};

/// Times that experts are recorded again for those that did not succeed.
const EXPERT_ROUNDS: u32 = 3;
/// Episodes of one simulator in a row.
const EPISODES_A_RUN: u64 = 10;

/// What the replay holds before the policy acts.
#[derive(Debug)]
pub struct Prefilled {
    /// Everything.
    pub replay: Replay,
    /// Successful episodes of the expert, or of the data.
    pub demonstrations: u64,
    /// Whether the newest episodes of the policy succeeded, oldest first.
    pub policy_successes: Vec<bool>,
}

/// Folder of a run's own episodes.
#[must_use]
pub fn episodes_folder(run: &Path) -> PathBuf {
    run.join("episodes")
}

/// Fills the replay: from the settings' data where they name some, else from simulators, whose episodes are kept in the run's folder;
/// and with what the policy of an earlier part of this run has recorded there.
///
/// # Errors
/// See [`TrainingError`]; [`TrainingError::NoDemonstrations`] if demonstrations are wanted and none was successful.
pub fn prefill(
    run: &Path,
    settings: &TrainingSettings,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Prefilled, TrainingError> {
    let mut filled = Filled::new(settings);
    if settings.data.as_os_str().is_empty() {
        record(run, settings, stop, progress)?;
    } else {
        filled.take_from_data(&settings.data)?;
    }
    let own = episodes_folder(run).join(&settings.task);
    if own.is_dir() && has_episodes(&own) {
        filled.take_own(&own)?;
    }
    let wanted = settings.finetune.expert_episodes;
    if wanted > 0 && filled.demonstrations == 0 && !stop.load(Ordering::Relaxed) {
        let path = if settings.data.as_os_str().is_empty() { own } else { settings.data.clone() };
        let episodes = filled.replay.episodes();
        return Err(TrainingError::NoDemonstrations { path, task: settings.task.clone(), episodes });
    }
    let Filled { replay, demonstrations, policy_successes, .. } = filled;
    Ok(Prefilled { replay, demonstrations, policy_successes })
}

struct Filled<'a> {
    settings: &'a TrainingSettings,
    replay: Replay,
    demonstrations: u64,
    policy_successes: Vec<bool>,
}

impl<'a> Filled<'a> {
    fn new(settings: &'a TrainingSettings) -> Self {
        let replay = Replay::new(settings.replay.capacity_steps).fitting(&settings.model);
        Self { settings, replay, demonstrations: 0, policy_successes: Vec::new() }
    }

    fn add(&mut self, path: &Path, episode: Episode) -> Result<(), TrainingError> {
        let refused = |source| LoadError::Refused { path: path.to_path_buf(), source };
        Ok(self.replay.add(&self.settings.task, episode).map_err(refused)?)
    }

    /// The first successful episodes as demonstrations, and of the others as many steps as are to be random.
    fn take_from_data(&mut self, data: &Path) -> Result<(), TrainingError> {
        let FinetuneSettings { expert_episodes, random_steps, .. } = self.settings.finetune;
        let mut others = 0;
        for read in Folder::list_task(data, &self.settings.task)?.episodes() {
            let (_, path, episode) = read?;
            if episode.succeeded() && self.demonstrations < expert_episodes {
                self.demonstrations += 1;
                self.add(path, episode)?;
            } else if !episode.succeeded() && others < random_steps {
                others += episode.len() as u64;
                self.add(path, episode)?;
            }
            if self.demonstrations == expert_episodes && others >= random_steps {
                break;
            }
        }
        Ok(())
    }

    /// Everything that this run has recorded, in the order of names, which is that of time.
    fn take_own(&mut self, own: &Path) -> Result<(), TrainingError> {
        for read in Folder::list(own, None)?.episodes() {
            let (_, path, episode) = read?;
            if is_of(path, Script::Expert.name()) {
                self.demonstrations += u64::from(episode.succeeded());
            } else if is_of(path, POLICY) {
                self.policy_successes.push(episode.succeeded());
            }
            self.add(path, episode)?;
        }
        Ok(())
    }
}

/// Beginning of the names of the policy's episodes: they sort behind those of the scripts.
const POLICY: &str = "step";

/// Where the policy's episode goes that was finished after so many of its steps.
#[must_use]
pub fn policy_episode(run: &Path, task: &str, steps: u64, simulator: usize) -> PathBuf {
    episodes_folder(run).join(task).join(format!("{POLICY}-{steps:09}-simulator{simulator}.npz"))
}

fn is_of(path: &Path, beginning: &str) -> bool {
    path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&format!("{beginning}-")))
}

fn has_episodes(folder: &Path) -> bool {
    std::fs::read_dir(folder).is_ok_and(|mut entries| {
        entries.any(|entry| entry.is_ok_and(|entry| entry.path().extension().is_some_and(|x| x == "npz")))
    })
}

/// Records the experts and the random steps that are missing; more experts where some have failed.
fn record(
    run: &Path,
    settings: &TrainingSettings,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<(), TrainingError> {
    let finetune = &settings.finetune;
    let collecting = CollectSettings {
        out: episodes_folder(run),
        seed: settings.seed,
        simulators: finetune.simulators.max(1),
        steps_max: finetune.episode_steps,
        disturb: finetune.disturb.clone(),
    };
    let random = finetune.random_steps.div_ceil(u64::from(finetune.episode_steps));
    let mut expert = finetune.expert_episodes;
    for round in 0..EXPERT_ROUNDS {
        let amounts = Amounts { expert, random, ..Amounts::default() };
        let amounts = Amounts { masked: if finetune.masks { amounts.total() } else { 0 }, ..amounts };
        let tasks = [settings.task.clone()];
        let plan = Plan::new(&collecting.out, &tasks, &amounts, settings.seed, EPISODES_A_RUN);
        collect(&plan, &collecting, stop, progress)?;
        let missing = finetune.expert_episodes.saturating_sub(successes(&collecting.out, &settings.task)?);
        if missing == 0 || round + 1 == EXPERT_ROUNDS || stop.load(Ordering::Relaxed) {
            break;
        }
        expert += missing;
    }
    Ok(())
}

/// Successful episodes of the expert in the folder of a task.
fn successes(out: &Path, task: &str) -> Result<u64, TrainingError> {
    let folder = out.join(task);
    if !has_episodes(&folder) {
        return Ok(0);
    }
    let mut count = 0;
    for read in Folder::list(&folder, None)?.episodes() {
        let (_, path, episode) = read?;
        count += u64::from(is_of(path, Script::Expert.name()) && episode.succeeded());
    }
    Ok(count)
}
