use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use image::RgbImage;
use rcwm_models::bundle::{Bundle, MANIFEST_BYTES_MAX, MANIFEST_FILE, Provenance};
use rcwm_models::episode::Episode;
use rcwm_models::files::{read_capped, sha256_hex};
use rcwm_models::settings::ModelSettings;
use rcwm_models::tasks::task_id;
use serde::{Deserialize, Serialize};

use super::pooled::{Pooled, Training, pool};
use super::{Draft, Measurement, Part, ReportError, shown_words};
use crate::evaluation::{
    ClosedLoopReport, ClosedLoopSettings, Interval, Position, closed_loop, recorded_episode,
};
use crate::plots::write_gif;

/// A film shows one step in so many, each for so many hundredths of a second: about real speed at 40 steps a second.
const FILM_EVERY: usize = 3;
const FILM_STEP_CS: u16 = 8;
/// Steps that a film goes on after the task is solved.
const FILM_AFTER: usize = 25;

/// A bundle and the task it is for.
#[derive(Debug, Clone)]
pub struct Policy {
    pub name: String,
    pub task: String,
    /// The bundle's folder.
    pub folder: PathBuf,
    /// Of the manifest, which holds those of all other files.
    pub sha256: String,
    /// The sizes.
    pub model: ModelSettings,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// What a policy was run with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SuccessSource {
    /// The policy's name.
    pub policy: String,
    pub task: String,
    /// Of the bundle's manifest.
    pub bundle_sha256: String,
    /// Visual disturbance.
    pub disturb: String,
    pub episodes: u64,
    /// Seed of their layouts.
    pub seed: u64,
    /// Decisions in an episode.
    pub steps_max: u32,
    /// The runtime's engine.
    pub engine: String,
    /// Whether latents and actions were drawn; then also by how many runtimes, which each draw their own.
    pub sampled_by: Option<u64>,
}

/// How long the runtime took from image to action, in microseconds; of several runtimes the slowest.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Tick {
    /// Median.
    pub p50_us: f64,
    /// 99th percentile.
    pub p99_us: f64,
}

/// How well a policy solves a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Success {
    /// Whole episodes.
    pub episodes: usize,
    /// Those in which the task was solved at some step.
    pub successes: usize,
    /// Wilson's 95% interval of the rate.
    pub interval: Interval,
    /// Mean return of an episode.
    pub return_mean: f64,
    /// Standard deviation over episodes.
    pub return_std: f64,
    /// By episode.
    pub returns: Vec<f64>,
    /// By episode.
    pub successful: Vec<bool>,
    /// Decisions in all.
    pub steps: u64,
    /// None if the runtime did not say.
    pub tick: Option<Tick>,
    /// Answers of the fallback, which are not the policy's; none if the runtime did not say.
    pub fallback_answers: Option<u64>,
    /// Films of an episode that was solved and of one that was not.
    pub films: Vec<SuccessFilm>,
    /// The sizes.
    pub model: ModelSettings,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// The film of one episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SuccessFilm {
    /// Its number among the episodes.
    pub episode: usize,
    /// At which step the task was solved first.
    pub solved_at: Option<usize>,
    /// Which of the part's pictures it is.
    pub picture: usize,
}

impl Measurement for Success {
    const KIND: &'static str = "success";
    type Source = SuccessSource;

    fn names(source: &SuccessSource) -> Vec<&str> {
        vec![&source.policy, &source.task, &source.disturb]
    }
}

impl Policy {
    /// What its part would be measured from.
    #[must_use]
    pub fn source(&self, settings: &ClosedLoopSettings) -> SuccessSource {
        SuccessSource {
            policy: self.name.clone(),
            task: self.task.clone(),
            bundle_sha256: self.sha256.clone(),
            disturb: settings.disturb.clone(),
            episodes: settings.episodes,
            seed: settings.seed,
            steps_max: settings.steps_max,
            engine: settings.engine.clone(),
            sampled_by: settings.sample.then_some(settings.simulators),
        }
    }

    /// Runs it and films one episode that it solved and one that it did not. `seen` hears how far each simulator is.
    pub fn measure(
        &self,
        settings: &ClosedLoopSettings,
        draft: &mut Draft,
        stop: &AtomicBool,
        seen: impl FnMut(&[Position]),
    ) -> Result<Success, ReportError> {
        let report = closed_loop(&self.folder, settings, stop, seen)?;
        let mut films = Vec::new();
        // What is drawn by chance would be another episode the second time.
        let wanted: &[bool] = if settings.sample { &[] } else { &[true, false] };
        for solved in wanted {
            let Some(number) = report.successful.iter().position(|success| success == solved) else {
                continue;
            };
            let episode = recorded_episode(&self.folder, settings, number as u64, stop)?;
            let solved_at = episode.success.iter().position(|success| *success);
            // A film that shows something else than what was counted is not shown.
            if solved_at.is_some() == *solved {
                let name = if *solved { "solved.gif" } else { "unsolved.gif" };
                write_gif(&frames(&episode, solved_at), FILM_STEP_CS, &draft.picture(name))?;
                films.push(SuccessFilm { episode: number, solved_at, picture: films.len() });
            }
        }
        Ok(self.summary(report, films))
    }

    fn summary(&self, report: ClosedLoopReport, films: Vec<SuccessFilm>) -> Success {
        let fallback = |runtime: &serde_json::Value| runtime["counters"]["fallback_answers"].as_u64();
        Success {
            episodes: report.episodes,
            successes: report.successes,
            interval: report.interval,
            return_mean: report.return_mean,
            return_std: report.return_std,
            tick: tick(&report.runtimes),
            fallback_answers: report.runtimes.iter().map(fallback).sum(),
            returns: report.returns,
            successful: report.successful,
            steps: report.steps,
            films,
            model: self.model.clone(),
            provenance: self.provenance.clone(),
        }
    }
}

/// The policies in folders of bundles, and what was left out and why. A bundle is for the task that its folder is called, else, if it is
/// trained, for the one that its manifest names.
///
/// # Errors
/// [`ReportError::NoBundles`], [`ReportError::SamePolicy`], [`ReportError::Bundle`] or [`ReportError::Folder`].
pub fn policies(folders: &[PathBuf]) -> Result<(Vec<Policy>, Vec<String>), ReportError> {
    let (mut found, mut left_out): (Vec<Policy>, Vec<String>) = (Vec::new(), Vec::new());
    for folder in folders {
        let before = found.len();
        for place in bundle_folders(folder)? {
            let policy = policy(folder, &place)?;
            match policy {
                Ok(policy)
                    if found.iter().any(|other| other.name == policy.name && other.task == policy.task) =>
                {
                    return Err(ReportError::SamePolicy { name: policy.name, task: policy.task });
                }
                Ok(policy) => found.push(policy),
                Err(reason) => left_out.push(reason),
            }
        }
        if found.len() == before {
            return Err(ReportError::NoBundles { path: folder.clone() });
        }
    }
    Ok((found, left_out))
}

/// Policies of one task that differ in their training seed only, taken together: of the same sizes and updates, where a seed comes twice
/// also of the same data. Those that have no other beside them are left out.
pub(super) fn over_seeds(parts: &[Part<Success>]) -> Vec<Pooled> {
    let sizes = |a: &Success, b: &Success| {
        let of = |x: &Success| (x.model.clone(), x.provenance.preset.clone(), x.provenance.updates);
        of(a) == of(b)
    };
    let data = |a: &Success, b: &Success| a.provenance.data == b.provenance.data;
    let repeated = |group: &[&Part<Success>]| {
        let seeds: Vec<_> = group.iter().map(|part| &part.measured.provenance.seeds).collect();
        seeds.iter().enumerate().any(|(place, seeds_of)| seeds[..place].contains(seeds_of))
    };
    let mut found = Vec::new();
    for group in split(parts.iter(), sizes) {
        let groups = if repeated(&group) { split(group.into_iter(), data) } else { vec![group] };
        for group in groups.into_iter().filter(|group| group.len() > 1 && !repeated(group)) {
            let trainings: Vec<Training> = group
                .iter()
                .map(|part| {
                    Training::of(part.measured.successes, part.measured.episodes, part.measured.return_mean)
                })
                .collect();
            let names: Vec<&str> = group.iter().map(|part| part.source.policy.as_str()).collect();
            let source = &group[0].source;
            found.push(pool(&names.join(", "), &source.task, &source.disturb, &trainings));
        }
    }
    found
}

/// Parts on the same task that are alike, in the order of the first.
fn split<'a>(
    parts: impl Iterator<Item = &'a Part<Success>>,
    alike: impl Fn(&Success, &Success) -> bool,
) -> Vec<Vec<&'a Part<Success>>> {
    let same = |a: &Part<Success>, b: &Part<Success>| {
        (&a.source.task, &a.source.disturb) == (&b.source.task, &b.source.disturb)
            && alike(&a.measured, &b.measured)
    };
    let mut groups: Vec<Vec<&Part<Success>>> = Vec::new();
    for part in parts {
        match groups.iter_mut().find(|group| same(group[0], part)) {
            Some(group) => group.push(part),
            None => groups.push(vec![part]),
        }
    }
    groups
}

/// The folder itself if it is a bundle, else the bundles in it.
fn bundle_folders(folder: &Path) -> Result<Vec<PathBuf>, ReportError> {
    let is_bundle = |path: &PathBuf| path.join(MANIFEST_FILE).is_file();
    let own = folder.to_path_buf();
    if is_bundle(&own) {
        return Ok(vec![own]);
    }
    let fail = |source| ReportError::Folder { path: folder.to_path_buf(), source };
    let entries = std::fs::read_dir(folder).map_err(fail)?;
    let mut paths: Vec<PathBuf> =
        entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<_>>().map_err(fail)?;
    paths.retain(is_bundle);
    paths.sort();
    Ok(paths)
}

/// The policy of a bundle, or why it is left out.
fn policy(folder: &Path, place: &Path) -> Result<Result<Policy, String>, ReportError> {
    let wrong = |source| ReportError::Bundle { path: place.to_path_buf(), source: Box::new(source) };
    let manifest = Bundle::open(place).map_err(wrong)?.manifest;
    let sha256 = sha256_hex(&read_capped(&place.join(MANIFEST_FILE), MANIFEST_BYTES_MAX)?);
    let own = name_of(place);
    let (name, task) = if task_id(&own).is_ok() {
        // A folder that is itself a bundle has no name beside its task's.
        (if folder == place { own.clone() } else { name_of(folder) }, own.clone())
    } else if manifest.provenance.updates == 0 {
        return Ok(Err(format!("{own}: random weights, and its folder is not named after a task")));
    } else if task_id(&manifest.task).is_ok() {
        (own.clone(), manifest.task)
    } else {
        return Ok(Err(format!("{own}: neither its folder nor its manifest names a task")));
    };
    let Some(model) = manifest.model else {
        return Ok(Err(format!("{own}: kind {} has no world model to report on", manifest.kind)));
    };
    let data = shown_words(&manifest.provenance.data);
    let provenance = Provenance { data, ..manifest.provenance };
    Ok(Ok(Policy { name, task, folder: place.to_path_buf(), sha256, model, provenance }))
}

fn name_of(path: &Path) -> String {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Latency of the tick, of the slowest runtime.
fn tick(runtimes: &[serde_json::Value]) -> Option<Tick> {
    let of = |runtime: &serde_json::Value| {
        let stages = runtime["latency"].as_array()?;
        let stage = stages.iter().find(|stage| stage["stage"] == "tick")?;
        Some(Tick { p50_us: stage["p50_us"].as_f64()?, p99_us: stage["p99_us"].as_f64()? })
    };
    let slowest = |a: Tick, b: Tick| Tick { p50_us: a.p50_us.max(b.p50_us), p99_us: a.p99_us.max(b.p99_us) };
    runtimes.iter().map(of).collect::<Option<Vec<_>>>()?.into_iter().reduce(slowest)
}

/// What the camera saw, up to a little after the task was solved.
fn frames(episode: &Episode, solved_at: Option<usize>) -> Vec<RgbImage> {
    let end = solved_at.map_or(episode.len(), |step| (step + FILM_AFTER).min(episode.len()));
    let side = episode.side() as u32;
    let frame = |step: usize| {
        let image = episode.image.index_axis(ndarray::Axis(0), step);
        RgbImage::from_fn(side, side, |x, y| {
            image::Rgb(std::array::from_fn(|channel| image[[y as usize, x as usize, channel]]))
        })
    };
    (0..end).step_by(FILM_EVERY).map(frame).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_slowest_runtime_counts_and_silence_is_no_number() {
        let runtime =
            |p50: f64, p99: f64| json!({"latency": [{"stage": "tick", "p50_us": p50, "p99_us": p99}]});
        let found = tick(&[runtime(1.0, 9.0), runtime(2.0, 8.0)]);
        assert_eq!(found, Some(Tick { p50_us: 2.0, p99_us: 9.0 }));
        assert_eq!(tick(&[runtime(1.0, 9.0), json!({})]), None);
        assert_eq!(tick(&[]), None);
    }

    #[test]
    fn a_film_ends_a_little_after_success() {
        let episode = Episode::blank(120);
        assert_eq!(frames(&episode, None).len(), 40);
        assert_eq!(frames(&episode, Some(5)).len(), 10);
        assert_eq!(frames(&episode, Some(119)).len(), 40);
    }

    #[test]
    fn a_folder_without_bundles_is_one_clear_error() {
        let folder = tempfile::tempdir().unwrap();
        let error = policies(&[folder.path().to_path_buf()]).unwrap_err().to_string();
        assert!(error.contains("holds no bundle") && error.contains("hammer"), "{error}");
    }
}
