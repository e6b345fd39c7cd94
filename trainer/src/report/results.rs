use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rcwm_models::files::sha256_hex;
use serde::{Deserialize, Serialize};

use super::{Measurement, ReportError, shown_path};
use crate::evaluation::{ClosedLoopResults, Interval, mean_and_std, wilson};

/// The result files that were given last.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResultsSource {
    /// Label and checksum of each.
    pub files: Vec<(String, String)>,
}

/// One policy on one task, as a result file says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResultEntry {
    /// What it is compared as: entries of one label are seeds of the same.
    pub label: String,
    /// Where the policy lay.
    pub of: String,
    /// The task.
    pub task: String,
    /// Visual disturbance.
    pub disturb: String,
    /// Seed of the layouts.
    pub seed: u64,
    /// Episodes.
    pub episodes: usize,
    /// Those that were solved.
    pub successes: usize,
    /// Mean return.
    pub return_mean: f64,
}

/// What the result files say.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// In the order they were given.
    pub entries: Vec<ResultEntry>,
}

/// Entries of one label on one task, taken together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pooled {
    /// Label.
    pub label: String,
    /// Task.
    pub task: String,
    /// Visual disturbance.
    pub disturb: String,
    /// Episodes in all.
    pub episodes: usize,
    /// Those that were solved.
    pub successes: usize,
    /// Wilson's 95% interval over all episodes.
    pub interval: Interval,
    /// Mean of the entries' mean returns, each weighing as many episodes as it has.
    pub return_mean: Option<f64>,
    /// Success rate of each entry.
    pub rates: Vec<f64>,
    /// Their mean and standard deviation, from two on.
    pub spread: Option<(f64, f64)>,
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
            source.files.push(known);
            let of =
                file.of.as_deref().map_or_else(String::new, |of: &Path| shown_path(&of.to_string_lossy()));
            entries.extend(file.tasks.into_iter().map(|report| ResultEntry {
                label: label.clone(),
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
        groups.into_values().map(|entries| pool(&entries)).collect()
    }
}

fn pool(entries: &[&ResultEntry]) -> Pooled {
    let (first, episodes) = (entries[0], entries.iter().map(|entry| entry.episodes).sum());
    let successes = entries.iter().map(|entry| entry.successes).sum();
    let returned: f64 = entries.iter().map(|entry| entry.return_mean * entry.episodes as f64).sum();
    let rates: Vec<f64> =
        entries.iter().map(|entry| entry.successes as f64 / entry.episodes.max(1) as f64).collect();
    Pooled {
        label: first.label.clone(),
        task: first.task.clone(),
        disturb: first.disturb.clone(),
        episodes,
        successes,
        interval: wilson(successes, episodes),
        return_mean: (episodes > 0).then(|| returned / episodes as f64),
        spread: if rates.len() > 1 { mean_and_std(rates.iter().copied()) } else { None },
        rates,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(label: &str, task: &str, successes: usize) -> ResultEntry {
        ResultEntry {
            label: label.into(),
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
        assert_eq!(pooled[1].interval, wilson(18, 20));
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
