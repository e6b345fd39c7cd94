use maud::Markup;
use rcwm_models::files::read_capped;
use rcwm_models::settings::ModelKind;
use serde::Serialize;

use super::{
    AttentionPart, Dynamics, Learning, LearningCurve, Part, Pooled, Provenance, ReportError, Results, Store,
    Success, SuccessComparison, html, pooled, success,
};
use crate::evaluation::{Comparison, OverSeeds, Trained};

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
    pub made: Provenance,
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
    /// Every later label against the first.
    pub success_comparisons: Vec<SuccessComparison>,
    /// Policies in closed loop that differ in their training seed only, taken together, and these compared.
    pub policies_over_seeds: (Vec<Pooled>, Vec<SuccessComparison>),
    /// Models on recorded trajectories that differ in their training seed only, taken together, and these compared.
    pub over_seeds: Vec<SeedsPart>,
    #[serde(skip)]
    pub(super) store: Store,
}

/// A comparison, and on which data.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Compared {
    /// How the data were disturbed.
    pub disturb: String,
    #[serde(flatten)]
    pub comparison: Comparison,
}

/// Training seeds taken together on one task's trajectories.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SeedsPart {
    /// How the data were disturbed.
    pub disturb: String,
    /// Groups and comparisons.
    #[serde(flatten)]
    pub over: OverSeeds,
}

impl Report {
    /// Reads all parts of a report.
    pub fn read(store: &Store, made: Provenance, command: String) -> Result<Self, ReportError> {
        let mut dynamics: Vec<Part<Dynamics>> = store.all()?;
        // RCWM first: it has the first colour everywhere.
        let is_baseline = |part: &Part<Dynamics>| part.measured.checkpoint.model.kind == ModelKind::Vanilla;
        dynamics
            .sort_by_key(|part| (part.source.task.clone(), part.source.disturb.clone(), is_baseline(part)));
        let results: Vec<Part<Results>> = store.all()?;
        let learning: Vec<Part<Learning>> = store.all()?;
        let success: Vec<Part<Success>> = store.all()?;
        let by_label: Vec<Pooled> = results.iter().flat_map(|part| part.measured.pooled()).collect();
        let by_policy = success::over_seeds(&success);
        Ok(Self {
            format: FORMAT,
            made,
            command,
            success,
            comparisons: compared(&dynamics),
            over_seeds: over_seeds(&dynamics),
            dynamics,
            attention: store.all()?,
            success_comparisons: pooled::compared(&by_label),
            pooled: by_label,
            policies_over_seeds: (by_policy.clone(), pooled::compared(&by_policy)),
            results,
            learning_curves: learning.iter().flat_map(|part| part.measured.curves()).collect(),
            learning,
            store: store.clone(),
        })
    }

    /// One of a part's pictures.
    pub(super) fn picture(&self, file: &str, class: &str, words: &str) -> Result<Markup, ReportError> {
        let bytes = read_capped(&self.store.picture(file), PICTURE_BYTES_MAX)?;
        Ok(html::picture(&bytes, class, words))
    }
}

/// Models that were measured on the same trajectories, over training seeds.
fn over_seeds(parts: &[Part<Dynamics>]) -> Vec<SeedsPart> {
    let same = |a: &Part<Dynamics>, b: &Part<Dynamics>| {
        let (a, b) = (&a.source, &b.source);
        (&a.task, &a.data_sha256, &a.disturb, a.settings) == (&b.task, &b.data_sha256, &b.disturb, b.settings)
    };
    let mut groups: Vec<Vec<&Part<Dynamics>>> = Vec::new();
    for part in parts {
        match groups.iter_mut().find(|group| same(group[0], part)) {
            Some(group) => group.push(part),
            None => groups.push(vec![part]),
        }
    }
    let of = |group: Vec<&Part<Dynamics>>| {
        let trained = group.iter().map(|part| Trained {
            name: &part.source.model,
            settings: &part.measured.checkpoint,
            tasks: std::slice::from_ref(&part.measured.report),
        });
        let over = OverSeeds::of(&trained.collect::<Vec<_>>(), group[0].source.settings.seed);
        SeedsPart { disturb: group[0].source.disturb.clone(), over }
    };
    groups.into_iter().map(of).filter(|part| part.over != OverSeeds::default()).collect()
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
    use rcwm_models::bundle;
    use rcwm_models::settings::{ModelSettings, Preset};

    use super::*;
    use crate::checkpoint::CheckpointSettings;
    use crate::evaluation::{
        Answer, Measure, OpenLoopSettings, OtherActions, Response, Series, Share, TaskReport, wilson,
    };
    use crate::report::{DynamicsSource, SuccessFilm, SuccessSource};

    fn page(store: &Store) -> String {
        Report::read(store, Provenance::now("cpu"), "rcwm-trainer evaluate --report r".into())
            .unwrap()
            .html()
            .unwrap()
    }

    fn keep(store: &Store, policy: &str, solved: bool) {
        keep_training(store, policy, solved, 0);
    }

    fn keep_training(store: &Store, policy: &str, solved: bool, seed: u64) {
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
        let provenance = bundle::Provenance {
            preset: "debug".into(),
            data: "data".into(),
            updates: 1,
            seeds: vec![seed],
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
        store.keep(draft, source, success, Provenance::now("cpu"), 1.0).unwrap();
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
        let report = Report::read(&store, Provenance::now("cpu"), String::new()).unwrap();
        report.write(folder.path()).unwrap();
        let text = std::fs::read(folder.path().join("report.json")).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&text).unwrap();
        assert_eq!(json["success"][0]["measured"]["successful"], serde_json::json!([false]));
        assert!(folder.path().join("index.html").is_file());
        assert!(store.all::<Results>().unwrap().is_empty());
    }

    fn keep_dynamics(store: &Store, kind: ModelKind, seed: u64, error: f64) {
        let name = format!("{kind:?}-{seed}");
        let source = DynamicsSource {
            model: name.clone(),
            weights_sha256: name,
            task: "hammer".into(),
            disturb: "none".into(),
            data_sha256: "ab".into(),
            settings: OpenLoopSettings::default(),
        };
        let checkpoint = CheckpointSettings {
            format: crate::checkpoint::FORMAT,
            preset: "debug".into(),
            seed,
            updates: 7,
            data: "data".into(),
            cpu_seconds: 0.0,
            weights_sha256: String::new(),
            model: ModelSettings::preset(Preset::Debug, kind),
        };
        let series = |mean: f64| Series {
            mean: Some(mean),
            std: Some(0.0),
            interval: None,
            step_mean: vec![Some(mean)],
            step_std: vec![Some(0.0)],
        };
        let measures = Measure::ALL.map(|measure| (measure, series(error)));
        let share = Share { share: Some(0.25), interval: None, imagined: 0.1, truth: 0.2 };
        let report = TaskReport {
            task: "hammer".into(),
            trajectories: 3,
            episodes: 2,
            imagined: measures.clone().into(),
            posterior: measures.into(),
            kinds: Vec::new(),
            response: Some(Response {
                other: OtherActions::Still,
                answers: [(Answer::Environment, share)].into(),
            }),
            attention: None,
        };
        let mut draft = store.draft::<Dynamics>(&source).unwrap();
        for picture in ["strip-0.png", "response-0.png"] {
            std::fs::write(draft.picture(picture), b"\x89PNG").unwrap();
        }
        let (episode_of, robot_errors) = (vec![0, 0, 1], vec![Some(error); 3]);
        let found = Dynamics { checkpoint, report, episode_of, robot_errors, response_pictures: vec![1] };
        store.keep(draft, source, found, Provenance::now("cpu"), 1.0).unwrap();
    }

    #[test]
    fn models_of_several_seeds_are_compared_over_seeds_and_each_picture_has_its_section() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        for (seed, error) in [(0, 1.0), (1, 3.0)] {
            keep_dynamics(&store, ModelKind::Rcwm, seed, error);
            keep_dynamics(&store, ModelKind::Vanilla, seed, 4.0);
        }
        let report = Report::read(&store, Provenance::now("cpu"), String::new()).unwrap();
        let [part] = report.over_seeds.as_slice() else { panic!("{:?}", report.over_seeds) };
        let comparison = &part.over.comparisons[0];
        let interval = comparison.interval.unwrap();
        assert_eq!((comparison.ratio, interval.low, interval.high), (0.5, 0.25, 0.75));
        let page = report.html().unwrap();
        assert!(page.contains("2 and 2 training seeds; fewer than 5: no result yet"));
        assert_eq!(
            page.matches("with the robot held still in place").count(),
            4,
            "two action sequences each"
        );
        assert_eq!(
            page.matches("alt=\"hammer, Rcwm-0\"").count(),
            2,
            "each picture once, in its own section"
        );
        assert!(page.contains("0.250"));
    }

    #[test]
    fn policies_that_differ_in_their_training_seed_are_taken_together() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        keep_training(&store, "first", true, 0);
        keep_training(&store, "second", false, 1);
        let report = Report::read(&store, Provenance::now("cpu"), String::new()).unwrap();
        let [pooled] = report.policies_over_seeds.0.as_slice() else { panic!("two trainings") };
        assert_eq!((pooled.label.as_str(), pooled.rates.clone()), ("first, second", vec![1.0, 0.0]));
        assert!(report.html().unwrap().contains("2 seeds; fewer than 5: no result yet"));
        // The same seed twice is no second training.
        keep_training(&store, "second", false, 0);
        let report = Report::read(&store, Provenance::now("cpu"), String::new()).unwrap();
        assert!(report.policies_over_seeds.0.is_empty());
    }
}
