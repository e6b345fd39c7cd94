use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::{Episode, EpisodeError};
use rcwm_models::files::{FileError, free_name};
use rcwm_models::lock::Lock;
use rcwm_models::tasks::task_name;
use rcwm_models::wire::{ActionValues, Format};
use serde::Serialize;

use super::recorder::{Recorded, Recorder};
use super::{Client, CollectError, Job, LEARNING, Launch, Plan, SimulatorProcess, mismatches_to_record};

/// A simulator whose trainer is gone ends by itself after so long.
const SILENCE_MAX: Duration = Duration::from_secs(60);

/// How to collect.
#[derive(Debug, Clone)]
pub struct CollectSettings {
    /// Folder of the data.
    pub out: PathBuf,
    /// Seed of layouts and scripted decisions.
    pub seed: u64,
    /// Simulators at a time.
    pub simulators: usize,
    /// Decisions in an episode.
    pub steps_max: u32,
    /// Visual disturbance: one of [`DISTURBANCES`](super::DISTURBANCES).
    pub disturb: String,
}

/// What was collected, by task and script.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Collected {
    pub episodes: u64,
    /// Steps: decisions, the first observation of an episode not counted.
    pub steps: u64,
    /// Episodes in which the task was solved at some step.
    pub successes: u64,
    /// Episodes with masks.
    pub masked: u64,
    /// Sum of all rewards.
    pub reward_sum: f64,
}

/// Sums by task and script.
pub type Sums = BTreeMap<(String, String), Collected>;

impl Collected {
    fn add(&mut self, episode: &Episode) {
        self.episodes += 1;
        self.steps += episode.len().saturating_sub(1) as u64;
        self.successes += u64::from(episode.succeeded());
        self.masked += u64::from(episode.robot_mask.is_some());
        self.reward_sum += episode.total_reward();
    }
}

/// Progress of a collection.
#[derive(Debug, Clone, Copy)]
pub enum Progress {
    /// A step of an episode.
    Step,
    /// A whole episode was written.
    Episode,
}

/// Records the episodes of a plan with `settings.simulators` processes at a time. Whole episodes only are written, so that a collection
/// that was cut off goes on where it was.
///
/// # Errors
/// See [`CollectError`]: of the first simulator that fails; the others end after their present step.
pub fn collect(
    plan: &Plan,
    settings: &CollectSettings,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Sums, CollectError> {
    run_jobs(plan, settings, stop, progress, &|job, recorded| {
        recorded.episode.write(&job.file(&settings.out, settings.seed, recorded.number))?;
        Ok(())
    })
}

/// Has the scripts do once more what the episodes of a plan hold, with the disturbance of these settings, and adds what it looks like to
/// the episodes: [`Episode::disturbed`].
///
/// # Errors
/// See [`CollectError`]; episodes that did not get their pictures are as they were.
pub fn collect_disturbed(
    plan: &Plan,
    settings: &CollectSettings,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<(), CollectError> {
    run_jobs(plan, settings, stop, progress, &|job, recorded| {
        let path = job.file(&settings.out, settings.seed, recorded.number);
        let (mut episode, again) = (Episode::read(&path)?, &recorded.episode);
        if (&episode.action, &episode.reward) != (&again.action, &again.reward) {
            return Err(CollectError::OtherEpisode { path, look: settings.disturb.clone() });
        }
        episode.disturbed = Some(again.image.clone());
        Ok(episode.write(&path)?)
    })
    .map(drop)
}

/// What becomes of a recorded episode.
type Keep<'a> = &'a (dyn Fn(&Job, &Recorded) -> Result<(), CollectError> + Sync);

fn run_jobs(
    plan: &Plan,
    settings: &CollectSettings,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
    keep: Keep<'_>,
) -> Result<Sums, CollectError> {
    let mut locks = BTreeMap::new();
    for task in plan.jobs.iter().map(|job| job.task.as_str()) {
        let folder = settings.out.join(task);
        make_folder(&folder)?;
        if !locks.contains_key(task) {
            locks.insert(task, Lock::take(&folder)?);
        }
    }
    let queue = Mutex::new(plan.jobs.iter());
    let failed = AtomicBool::new(false);
    let worker = |number: usize| -> Result<Sums, CollectError> {
        let mut sums = Sums::new();
        let mut run = 0;
        // The lock is held for the taking only.
        let take = || queue.lock().ok().and_then(|mut jobs| jobs.next());
        while let (false, Some(job)) = (ended(stop, &failed), take()) {
            let instance = format!("collect-{}-{number}-{run}", std::process::id());
            run += 1;
            if let Err(error) = run_job(job, &instance, settings, stop, progress, keep, &mut sums) {
                failed.store(true, Ordering::Relaxed);
                return Err(error);
            }
        }
        Ok(sums)
    };
    let results: Vec<_> = std::thread::scope(|scope| {
        let workers: Vec<_> =
            (0..settings.simulators.max(1)).map(|number| scope.spawn(move || worker(number))).collect();
        workers.into_iter().map(|worker| worker.join().expect("workers do not panic")).collect()
    });
    let mut total = Sums::new();
    for sums in results {
        for (key, part) in sums? {
            total.entry(key).or_default().merge(&part);
        }
    }
    Ok(total)
}

impl Collected {
    fn merge(&mut self, other: &Self) {
        self.episodes += other.episodes;
        self.steps += other.steps;
        self.successes += other.successes;
        self.masked += other.masked;
        self.reward_sum += other.reward_sum;
    }
}

fn ended(stop: &AtomicBool, failed: &AtomicBool) -> bool {
    stop.load(Ordering::Relaxed) || failed.load(Ordering::Relaxed)
}

fn run_job(
    job: &Job,
    instance: &str,
    settings: &CollectSettings,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
    keep: Keep<'_>,
    sums: &mut Sums,
) -> Result<(), CollectError> {
    let process = SimulatorProcess::start(&Launch {
        task: job.task.clone(),
        instance: instance.to_owned(),
        layouts: LEARNING.to_owned(),
        seed: settings.seed,
        first_episode: job.first_number(),
        episodes: job.episodes,
        steps_max: settings.steps_max,
        policy: job.script.name(),
        masks: job.masks,
        disturb: settings.disturb.clone(),
        program: None,
        silence_max: SILENCE_MAX,
    })?;
    let mut recorder = Recorder::new(Client::of(process, mismatches_to_record)?);
    // The simulator decides by itself: an answer is a receipt.
    while let Some(recorded) = recorder.episode(stop, Format::rest, || progress(Progress::Step))? {
        keep(job, &recorded)?;
        sums.entry((job.task.clone(), job.script.name().to_owned())).or_default().add(&recorded.episode);
        progress(Progress::Episode);
    }
    Ok(())
}

/// Records episodes of a simulator that runs already, until `episodes` were progress or it ends. Every observation is answered by a
/// random action: a scripted simulator takes it as a receipt, one that waits for a policy executes it.
pub fn record(
    instance: &str,
    episodes: u64,
    out: &Path,
    seed: u64,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Sums, CollectError> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut recorder = Recorder::new(Client::join(instance, mismatches_to_record)?);
    let mut sums = Sums::new();
    for _ in 0..episodes {
        let decide = |format: &Format| {
            let chosen = ActionValues::from_fn(format.action_numbers(), |_| random.random_range(-1.0..=1.0));
            let mut units = format.zeros();
            // Finite: drawn from [-1, 1].
            let _ = format.normaliser().to_units(&chosen, &mut units);
            units
        };
        let recorded = recorder.episode(stop, decide, || progress(Progress::Step))?;
        let Some(Recorded { number, task, episode }) = recorded else { break };
        let folder = out.join(task_name(task));
        make_folder(&folder)?;
        write_numbered(&episode, &folder.join(format!("{instance}-{number:05}.npz")))?;
        sums.entry((task_name(task).to_owned(), instance.to_owned())).or_default().add(&episode);
        progress(Progress::Episode);
    }
    Ok(sums)
}

/// Writes under a name that is not taken: numbers begin anew with every simulator. Others may write there at the same time.
fn write_numbered(episode: &Episode, path: &Path) -> Result<(), EpisodeError> {
    loop {
        let free = free_name(path, |name| !name.exists());
        match episode.write_new(&free) {
            Err(EpisodeError::File(FileError::Exists { .. })) => {}
            other => return other,
        }
    }
}

fn make_folder(path: &Path) -> Result<(), CollectError> {
    std::fs::create_dir_all(path).map_err(|source| CollectError::Folder { path: path.to_path_buf(), source })
}
