use std::path::Path;

use maud::{Markup, html};
use rcwm_models::files::{read_capped, write_atomic};
use rcwm_models::settings::ModelKind;
use serde::Serialize;

use super::results::Pooled;
use super::{
    AttentionPart, Dynamics, Learning, LearningCurve, Made, Part, ReportError, Results, Store, Success, html,
    sections,
};
use crate::evaluation::Comparison;

/// Version of `report.json`.
const FORMAT: u32 = 1;
/// Largest picture of a part, in bytes.
const PICTURE_BYTES_MAX: u64 = 64 << 20;

/// Everything that was measured, and how the page came to be.
#[derive(Debug, Serialize)]
#[serde(bound = "")]
pub struct Report {
    /// Version of the format.
    pub format: u32,
    /// When the page was drawn.
    pub made: Made,
    /// The command line that drew it.
    pub command: String,
    /// Policies in closed loop.
    pub success: Vec<Part<Success>>,
    /// Models on recorded trajectories.
    pub dynamics: Vec<Part<Dynamics>>,
    /// Robot dynamics errors of RCWM, divided by those of the baseline on the same trajectories.
    pub comparisons: Vec<Compared>,
    /// What the environment asks of the robot.
    pub attention: Vec<Part<AttentionPart>>,
    /// Result files.
    pub results: Vec<Part<Results>>,
    /// The same, by label.
    pub pooled: Vec<Pooled>,
    /// Runs that were evaluated while they learned.
    pub learning: Vec<Part<Learning>>,
    /// The same, by label.
    pub learning_curves: Vec<LearningCurve>,
    #[serde(skip)]
    pub(super) store: Store,
}

/// A comparison, and on which data.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Compared {
    /// How the data were disturbed.
    pub disturb: String,
    /// The comparison.
    #[serde(flatten)]
    pub comparison: Comparison,
}

impl Report {
    /// Reads all parts of a report.
    ///
    /// # Errors
    /// See [`ReportError`].
    pub fn read(store: &Store, made: Made, command: String) -> Result<Self, ReportError> {
        let mut dynamics: Vec<Part<Dynamics>> = store.all()?;
        // RCWM first: it has the first colour everywhere.
        let is_baseline = |part: &Part<Dynamics>| part.measured.checkpoint.model.kind == ModelKind::Vanilla;
        dynamics
            .sort_by_key(|part| (part.source.task.clone(), part.source.disturb.clone(), is_baseline(part)));
        let results: Vec<Part<Results>> = store.all()?;
        let learning: Vec<Part<Learning>> = store.all()?;
        Ok(Self {
            format: FORMAT,
            made,
            command,
            success: store.all()?,
            comparisons: compared(&dynamics),
            dynamics,
            attention: store.all()?,
            pooled: results.iter().flat_map(|part| part.measured.pooled()).collect(),
            results,
            learning_curves: learning.iter().flat_map(|part| part.measured.curves()).collect(),
            learning,
            store: store.clone(),
        })
    }

    /// Writes `index.html` and `report.json` into the report's folder.
    ///
    /// # Errors
    /// See [`ReportError`].
    pub fn write(&self, folder: &Path) -> Result<(), ReportError> {
        let page = self.html()?;
        let mut text = serde_json::to_vec_pretty(self).map_err(ReportError::Json)?;
        text.push(b'\n');
        write_atomic(&folder.join("report.json"), &text)?;
        Ok(write_atomic(&folder.join("index.html"), page.as_bytes())?)
    }

    /// The page.
    ///
    /// # Errors
    /// Those of reading and drawing pictures.
    pub fn html(&self) -> Result<String, ReportError> {
        let sections = sections::all(self)?;
        let body = html! {
            header {
                h1 { "RCWM: what the models can do" }
                p.soft {
                    "Drawn " (self.made.date) " by rcwm-trainer " (self.made.version) " (" (self.made.revision) ") on "
                    (self.made.processor) ", " (self.made.cores) " cores."
                }
                nav { @for section in &sections { a href={ "#" (section.id) } { (section.title) } } }
            }
            main { @for section in &sections {
                section id=(section.id) { h2 { (section.title) } (section.body) }
            } }
        };
        Ok(html::page("RCWM: what the models can do", &body))
    }

    /// One of a part's pictures.
    pub(super) fn picture(&self, file: &str, class: &str, words: &str) -> Result<Markup, ReportError> {
        let bytes = read_capped(&self.store.picture(file), PICTURE_BYTES_MAX)?;
        Ok(html::picture(&bytes, class, words))
    }
}

/// Every RCWM against every baseline that was measured on the same trajectories.
fn compared(parts: &[Part<Dynamics>]) -> Vec<Compared> {
    let of = |kind: ModelKind| parts.iter().filter(move |part| part.measured.checkpoint.model.kind == kind);
    let mut found = Vec::new();
    for ours in of(ModelKind::Rcwm) {
        let same = |other: &&Part<Dynamics>| {
            let (a, b) = (&ours.source, &other.source);
            (&a.task, &a.data_sha256, &a.disturb, a.settings)
                == (&b.task, &b.data_sha256, &b.disturb, b.settings)
        };
        for theirs in of(ModelKind::Vanilla).filter(same) {
            let comparison = Comparison::of_means(
                &ours.source.task,
                (&ours.source.model, &ours.measured.robot_errors),
                (&theirs.source.model, &theirs.measured.robot_errors),
                &ours.measured.episode_of,
                ours.source.settings.seed,
            );
            let disturb = ours.source.disturb.clone();
            found.extend(comparison.map(|comparison| Compared { disturb: disturb.clone(), comparison }));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use rcwm_models::bundle::Provenance;
    use rcwm_models::settings::{ModelSettings, Preset};

    use super::*;
    use crate::evaluation::wilson;
    use crate::report::{SuccessFilm, SuccessSource};

    fn page(store: &Store) -> String {
        Report::read(store, Made::now("cpu"), "rcwm-trainer evaluate --report r".into())
            .unwrap()
            .html()
            .unwrap()
    }

    fn keep(store: &Store, policy: &str, solved: bool) {
        let source = SuccessSource {
            policy: policy.into(),
            task: "hammer".into(),
            bundle_sha256: "ab".into(),
            disturb: "none".into(),
            episodes: 1,
            seed: 0,
            steps_max: 5,
            engine: "tract".into(),
            sampled_by: None,
        };
        let mut draft = store.draft::<Success>(&source).unwrap();
        std::fs::write(draft.picture("solved.gif"), b"GIF89a").unwrap();
        let provenance = Provenance {
            preset: "debug".into(),
            data: "data".into(),
            updates: 1,
            seeds: vec![0],
            source_revision: String::new(),
        };
        let success = Success {
            episodes: 1,
            successes: usize::from(solved),
            interval: wilson(usize::from(solved), 1),
            return_mean: 2.0,
            return_std: 0.0,
            returns: vec![2.0],
            successful: vec![solved],
            steps: 5,
            tick: None,
            fallback_answers: Some(0),
            films: vec![SuccessFilm { episode: 0, solved_at: Some(3), picture: 0 }],
            model: ModelSettings::preset(Preset::Debug, ModelKind::Rcwm),
            provenance,
        };
        store.keep(draft, source, success, Made::now("cpu"), 1.0).unwrap();
    }

    #[test]
    fn an_empty_report_says_what_adds_every_section() {
        let folder = tempfile::tempdir().unwrap();
        let page = page(&Store::open(folder.path()).unwrap());
        assert_eq!(page.matches("no policy").count(), 12, "all tasks of the paper");
        for option in ["--bundles", "--checkpoint", "--data", "--disturb ", "--disturbed-data", "--results"] {
            assert!(page.contains(option), "{option}");
        }
    }

    #[test]
    fn a_policy_is_a_row_with_its_film_and_what_is_missing_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        keep(&store, "<b>evil</b>", true);
        let page = page(&store);
        assert!(page.contains("&lt;b&gt;evil&lt;/b&gt;") && !page.contains("<b>evil"));
        assert!(page.contains("(1 of 1)") && page.contains("solved at step 3"));
        assert!(page.contains("data:image/gif;base64,") && page.contains("missing"), "no latency was told");
        assert_eq!(page.matches("no policy").count(), 11);
    }

    #[test]
    fn a_report_is_written_with_its_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        keep(&store, "policy", false);
        let report = Report::read(&store, Made::now("cpu"), String::new()).unwrap();
        report.write(folder.path()).unwrap();
        let text = std::fs::read(folder.path().join("report.json")).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&text).unwrap();
        assert_eq!(json["success"][0]["measured"]["successful"], serde_json::json!([false]));
        assert!(folder.path().join("index.html").is_file());
        assert!(store.all::<Results>().unwrap().is_empty());
    }
}
