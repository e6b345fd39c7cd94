use std::collections::BTreeMap;
use std::path::PathBuf;

use rcwm_models::files::{read_capped, sha256_hex};
use serde::{Deserialize, Serialize};

use super::{Measurement, ReportError};
use crate::evaluation::{Interval, mean_over_seeds};
use crate::training::{EvaluationFacts, METRICS_BYTES_MAX, Run};

/// The folders of runs that were given last.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LearningSource {
    /// Label of each, and the checksum of its metrics.
    pub runs: Vec<(String, String)>,
}

/// One run's evaluations while it learned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LearningRun {
    /// What it is compared as: runs of one label are seeds of the same.
    pub label: String,
    pub task: String,
    pub seed: u64,
    /// Steps of the policy between two evaluations.
    pub every_steps: u64,
    /// In the order they were made.
    pub evaluations: Vec<EvaluationFacts>,
}

/// Success of separate episodes while runs learned (paper, Fig. 6).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Learning {
    /// In the order they were given.
    pub runs: Vec<LearningRun>,
}

/// The seeds of one label on one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LearningCurve {
    pub label: String,
    pub task: String,
    /// The sets of layouts that its episodes were of.
    pub layouts: Vec<String>,
    pub seeds: Vec<u64>,
    /// In the order of steps.
    pub points: Vec<LearningPoint>,
}

/// A point of a curve.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LearningPoint {
    pub environment_steps: u64,
    /// Success rate of each seed that has come so far.
    pub rates: Vec<f64>,
    /// Their mean.
    pub mean: f64,
    /// Bootstrap over seeds, from two on.
    pub interval: Option<Interval>,
}

impl Measurement for Learning {
    const KIND: &'static str = "learning";
    type Source = LearningSource;

    fn names(_: &LearningSource) -> Vec<&str> {
        vec!["given"]
    }
}

/// A line of metrics, of which evaluations are read.
#[derive(Deserialize)]
struct Row {
    evaluation: Option<EvaluationFacts>,
}

impl Learning {
    /// Reads labelled folders of runs.
    ///
    /// # Errors
    /// [`ReportError::Run`], also where a label has a run twice, or [`ReportError::File`].
    pub fn read(folders: &[(String, PathBuf)]) -> Result<(LearningSource, Self), ReportError> {
        let (mut source, mut runs) = (LearningSource { runs: Vec::new() }, Vec::new());
        for (label, folder) in folders {
            let wrong = |reason: String| ReportError::Run { path: folder.clone(), reason };
            let settings = Run::settings(folder).map_err(|error| wrong(error.to_string()))?;
            let bytes = read_capped(&Run::metrics(folder), METRICS_BYTES_MAX)?;
            let known = (label.clone(), sha256_hex(&bytes));
            if source.runs.contains(&known) {
                return Err(wrong(format!("was given twice as {label:?}: it would count as two seeds")));
            }
            source.runs.push(known);
            // A line that cannot be read is one that is just being written.
            let text = String::from_utf8_lossy(&bytes);
            let rows = text.lines().filter_map(|line| serde_json::from_str::<Row>(line).ok());
            let evaluations: Vec<_> = rows.filter_map(|row| row.evaluation).collect();
            if evaluations.is_empty() {
                let why =
                    "holds no evaluations; learn with --set finetune.evaluation.every_steps=N".to_owned();
                return Err(wrong(why));
            }
            runs.push(LearningRun {
                label: label.clone(),
                task: settings.task,
                seed: settings.seed,
                every_steps: settings.finetune.evaluation.every_steps.max(1),
                evaluations,
            });
        }
        Ok((source, Self { runs }))
    }

    /// By task, then label in the order they were given.
    #[must_use]
    pub fn curves(&self) -> Vec<LearningCurve> {
        let mut order: Vec<&str> = Vec::new();
        let mut groups: BTreeMap<(&str, usize), Vec<&LearningRun>> = BTreeMap::new();
        for run in &self.runs {
            let known = order.iter().position(|label| *label == run.label);
            let place = known.unwrap_or(order.len());
            if known.is_none() {
                order.push(&run.label);
            }
            groups.entry((&run.task, place)).or_default().push(run);
        }
        groups.into_values().map(|runs| curve(&runs)).collect()
    }
}

fn curve(runs: &[&LearningRun]) -> LearningCurve {
    // An evaluation begins at the first decision after it is due, which differs by the number of simulators.
    let mut points: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for run in runs {
        for found in &run.evaluations {
            let repeat = found.environment_steps.checked_div(found.policy_steps).unwrap_or(1);
            let due = found.policy_steps / run.every_steps * run.every_steps * repeat;
            points.entry(due).or_default().push(found.successes as f64 / found.episodes.max(1) as f64);
        }
    }
    let mut layouts: Vec<String> =
        runs.iter().flat_map(|run| &run.evaluations).map(|found| found.layouts.clone()).collect();
    layouts.sort();
    layouts.dedup();
    let point = |(environment_steps, rates): (u64, Vec<f64>)| LearningPoint {
        environment_steps,
        mean: rates.iter().sum::<f64>() / rates.len() as f64,
        interval: mean_over_seeds(&rates, 0),
        rates,
    };
    LearningCurve {
        label: runs[0].label.clone(),
        task: runs[0].task.clone(),
        layouts,
        seeds: runs.iter().map(|run| run.seed).collect(),
        points: points.into_iter().map(point).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(label: &str, seed: u64, successes: &[u64]) -> LearningRun {
        let facts = |(index, successes): (usize, &u64)| EvaluationFacts {
            // Two simulators decide at once: a due step may be passed by one.
            policy_steps: 100 * index as u64 + u64::from(index > 0) * seed,
            environment_steps: 2 * (100 * index as u64 + u64::from(index > 0) * seed),
            layouts: "choosing".into(),
            episodes: 10,
            successes: *successes,
            return_mean: 0.0,
            seconds: 1.0,
        };
        let evaluations = successes.iter().enumerate().map(facts).collect();
        LearningRun { label: label.into(), task: "reach".into(), seed, every_steps: 100, evaluations }
    }

    #[test]
    fn seeds_of_a_label_are_one_curve_with_a_band_between_the_lowest_and_the_highest() {
        let runs = vec![run("rcwm", 0, &[0, 4, 9]), run("vanilla", 0, &[1]), run("rcwm", 1, &[2, 8])];
        let curves = Learning { runs }.curves();
        assert_eq!(curves.iter().map(|curve| curve.label.as_str()).collect::<Vec<_>>(), ["rcwm", "vanilla"]);
        let points = &curves[0].points;
        assert_eq!(points.iter().map(|point| point.environment_steps).collect::<Vec<_>>(), [0, 200, 400]);
        assert_eq!(points[1].rates, [0.4, 0.8]);
        assert!((points[1].mean - 0.6).abs() < 1e-12);
        let band = points[1].interval.unwrap();
        assert!((band.low - 0.4).abs() < 1e-12 && (band.high - 0.8).abs() < 1e-12, "{band:?}");
        assert_eq!((points[2].interval, curves[0].seeds.clone()), (None, vec![0, 1]));
    }
}
