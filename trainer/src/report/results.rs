use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rcwm_models::files::sha256_hex;
use serde::{Deserialize, Serialize};

use super::pooled::{Pooled, Training, pool};
use super::{Measurement, ReportError, shown_path};
use crate::evaluation::ClosedLoopResults;

/// The result files that were given last.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResultsSource {
    /// Label and checksum of each.
    pub files: Vec<(String, String)>,
}

/// One policy on one task, as a result file says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResultEntry {
    /// What it is compared as: policies of one label are trainings of the same that differ in their seed.
    pub label: String,
    /// Tells policies apart: a checksum of where the policy lay, or of the file that does not say it.
    #[serde(default)]
    pub policy: String,
    /// Where the policy lay.
    pub of: String,
    pub task: String,
    /// Visual disturbance.
    pub disturb: String,
    /// Seed of the layouts.
    pub seed: u64,
    pub episodes: usize,
    /// Those that were solved.
    pub successes: usize,
    pub return_mean: f64,
}

/// What the result files say.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// In the order they were given.
    pub entries: Vec<ResultEntry>,
}

impl Measurement for Results {
    const KIND: &'static str = "results";
    type Source = ResultsSource;

    fn names(_: &ResultsSource) -> Vec<&str> {
        vec!["given"]
    }
}

impl Results {
    /// Reads labelled result files.
    ///
    /// # Errors
    /// [`ReportError::Results`], also where a label has a file twice, or [`ReportError::File`].
    pub fn read(files: &[(String, PathBuf)]) -> Result<(ResultsSource, Self), ReportError> {
        let mut source = ResultsSource { files: Vec::new() };
        let mut entries = Vec::new();
        for (label, path) in files {
            let wrong = |reason: String| ReportError::Results { path: path.clone(), reason };
            let (file, bytes) = ClosedLoopResults::read(path)?;
            let known = (label.clone(), sha256_hex(&bytes));
            if source.files.contains(&known) {
                return Err(wrong(format!("was given twice as {label:?}: its episodes would count twice")));
            }
            let lay = file.of.as_deref().map(Path::to_string_lossy);
            let policy = lay.as_ref().map_or_else(|| known.1.clone(), |lay| sha256_hex(lay.as_bytes()));
            let of = lay.map_or_else(String::new, |lay| shown_path(&lay));
            source.files.push(known);
            entries.extend(file.tasks.into_iter().map(|report| ResultEntry {
                label: label.clone(),
                policy: policy.clone(),
                of: of.clone(),
                task: report.settings.task,
                disturb: report.settings.disturb,
                seed: report.settings.seed,
                episodes: report.episodes,
                successes: report.successes,
                return_mean: report.return_mean,
            }));
        }
        Ok((source, Self { entries }))
    }

    /// By task and disturbance, then label, in the order they were given.
    #[must_use]
    pub fn pooled(&self) -> Vec<Pooled> {
        let mut order: Vec<&str> = Vec::new();
        for entry in &self.entries {
            if !order.contains(&entry.label.as_str()) {
                order.push(&entry.label);
            }
        }
        let mut groups: BTreeMap<(&str, &str, usize), Vec<&ResultEntry>> = BTreeMap::new();
        for entry in &self.entries {
            let place = order.iter().position(|label| *label == entry.label).unwrap_or(0);
            groups.entry((&entry.task, &entry.disturb, place)).or_default().push(entry);
        }
        groups.into_values().map(|entries| pooled(&entries)).collect()
    }
}

/// Entries of one label on one task: first those of a policy are taken together, then the policies.
fn pooled(entries: &[&ResultEntry]) -> Pooled {
    let mut trainings: Vec<(&str, Training)> = Vec::new();
    for entry in entries {
        let found = Training::of(entry.successes, entry.episodes, entry.return_mean);
        // Parts from before policies were told apart hold one file a training.
        match trainings.iter_mut().find(|(policy, _)| !policy.is_empty() && *policy == entry.policy) {
            Some((_, training)) => training.add(&found),
            None => trainings.push((&entry.policy, found)),
        }
    }
    let trainings: Vec<Training> = trainings.into_iter().map(|(_, training)| training).collect();
    let first = entries[0];
    pool(&first.label, &first.task, &first.disturb, &trainings)
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::evaluation::Over;

    fn entry(label: &str, task: &str, successes: usize) -> ResultEntry {
        ResultEntry {
            label: label.into(),
            policy: String::new(),
            of: String::new(),
            task: task.into(),
            disturb: "none".into(),
            seed: 0,
            episodes: 10,
            successes,
            return_mean: successes as f64,
        }
    }

    #[test]
    fn seeds_of_a_label_are_pooled_and_each_is_still_told() {
        let entries = vec![
            entry("scratch", "hammer", 1),
            entry("pre-trained", "hammer", 8),
            entry("pre-trained", "hammer", 10),
            entry("pre-trained", "reach", 5),
        ];
        let pooled = Results { entries }.pooled();
        let found: Vec<_> = pooled.iter().map(|p| (p.task.as_str(), p.label.as_str(), p.successes)).collect();
        let expected = [("hammer", "scratch", 1), ("hammer", "pre-trained", 18), ("reach", "pre-trained", 5)];
        assert_eq!(found, expected);
        assert_eq!((pooled[1].episodes, pooled[1].rates.clone()), (20, vec![0.8, 1.0]));
        assert_eq!((pooled[1].return_mean, pooled[0].spread), (Some(9.0), None));
        let interval = pooled[1].interval;
        assert_eq!((interval.low, interval.high), (0.8, 1.0), "over two seeds, not over twenty episodes");
        assert_eq!((pooled[1].over, pooled[0].over), (Over::Seeds(2, 0), Over::Episodes));
    }

    #[test]
    fn files_of_one_policy_are_one_training_however_many_layouts_it_was_run_on() {
        let of = |policy: &str, successes| ResultEntry {
            policy: policy.into(),
            ..entry("a", "hammer", successes)
        };
        let entries = vec![of("x", 2), of("y", 9), of("x", 4)];
        let pooled = Results { entries }.pooled();
        assert_eq!(
            (pooled[0].rates.clone(), pooled[0].episodes, pooled[0].over),
            (vec![0.3, 0.9], 30, Over::Seeds(2, 0))
        );
    }

    #[test]
    fn a_file_given_twice_or_of_another_kind_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.json");
        std::fs::write(&file, r#"{"of": "/somewhere/else/x", "tasks": []}"#).unwrap();
        let of = |label: &str| (label.to_owned(), file.clone());
        assert!(Results::read(&[of("a"), of("b")]).is_ok());
        let text = Results::read(&[of("a"), of("a")]).unwrap_err().to_string();
        assert!(text.contains("twice"), "{text}");
        std::fs::write(&file, "{}").unwrap();
        let text = Results::read(&[of("a")]).unwrap_err().to_string();
        assert!(text.contains("a.json") && text.contains("--json"), "{text}");
    }
}
