//! What was measured of several trainings that differ in their seed only, taken together. What is drawn in a bootstrap is a training: its
//! episodes are pooled first, because how much trainings differ is what a comparison of two ways of learning must be held against.

use std::collections::BTreeMap;

use rcwm_models::settings::ModelKind;
use serde::Serialize;

use super::statistics::{Interval, interval_over_seeds, mean_and_std, mean_over_seeds};
use super::{Comparison, Measure, Over, TaskReport};
use crate::checkpoint::CheckpointSettings;

/// A training, and what was measured of it.
#[derive(Debug, Clone, Copy)]
pub struct Trained<'a> {
    pub name: &'a str,
    pub settings: &'a CheckpointSettings,
    pub tasks: &'a [TaskReport],
}

/// Trainings that differ in their seed only.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SeedGroup {
    /// What it is called.
    pub label: String,
    /// RCWM or vanilla.
    pub kind: ModelKind,
    /// Updates behind the weights; none where they differ.
    pub updates: Option<u64>,
    /// Seeds of the trainings.
    pub seeds: Vec<u64>,
    /// Names of the trainings, in the same order.
    pub members: Vec<String>,
    /// By task, kind of script and measure.
    pub rows: Vec<SeedRow>,
}

/// One measure of a group on a task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SeedRow {
    pub task: String,
    /// Kind of script; none for all.
    pub kind: Option<String>,
    /// What was measured.
    pub measure: Measure,
    /// Each training's mean over its trajectories, in the order of the seeds.
    pub values: Vec<f64>,
    /// Their mean.
    pub mean: f64,
    /// Their standard deviation (of the population).
    pub std: f64,
    /// 95% bootstrap interval of the mean; trainings are drawn.
    pub interval: Option<Interval>,
}

/// All groups, and these against each other.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct OverSeeds {
    /// The groups; empty where no two trainings differ in their seed only.
    pub groups: Vec<SeedGroup>,
    /// RCWM against vanilla after as many updates, if both are there; else every later group against the first.
    pub comparisons: Vec<Comparison>,
    /// What could not be taken together, and why.
    pub notes: Vec<String>,
}

impl OverSeeds {
    /// Groups trainings by kind and sizes of the model and by what they were trained on; where a seed comes twice in a group, also by
    /// updates. `seed` is that of the bootstrap.
    #[must_use]
    pub fn of(trained: &[Trained<'_>], seed: u64) -> Self {
        let mut notes = Vec::new();
        let groups = grouped(trained, &mut notes);
        if groups.iter().all(|group| group.len() < 2) {
            return Self { notes, ..Self::default() };
        }
        let mut found: Vec<SeedGroup> = groups.iter().map(|group| SeedGroup::of(group, seed)).collect();
        label(&mut found);
        let comparisons =
            pairs(&found).into_iter().flat_map(|(ours, theirs)| compared(ours, theirs, seed)).collect();
        Self { groups: found, comparisons, notes }
    }
}

/// The groups in the order of their first training.
fn grouped<'a>(trained: &[Trained<'a>], notes: &mut Vec<String>) -> Vec<Vec<Trained<'a>>> {
    let alike = |a: &CheckpointSettings, b: &CheckpointSettings| (&a.model, &a.data) == (&b.model, &b.data);
    let whole = split(trained, alike);
    let mut groups = Vec::new();
    for group in whole {
        if !repeated(&group) {
            groups.push(group);
            continue;
        }
        for group in split(&group, |a, b| a.updates == b.updates) {
            if !repeated(&group) {
                groups.push(group);
                continue;
            }
            let names: Vec<&str> = group.iter().map(|one| one.name).collect();
            notes.push(format!(
                "{}: of one kind, size and number of updates, and a training seed comes twice; not taken together over seeds",
                names.join(", ")
            ));
        }
    }
    groups
}

fn split<'a>(
    trained: &[Trained<'a>],
    alike: impl Fn(&CheckpointSettings, &CheckpointSettings) -> bool,
) -> Vec<Vec<Trained<'a>>> {
    let mut groups: Vec<Vec<Trained<'a>>> = Vec::new();
    for one in trained {
        match groups.iter_mut().find(|group| alike(group[0].settings, one.settings)) {
            Some(group) => group.push(*one),
            None => groups.push(vec![*one]),
        }
    }
    groups
}

fn repeated(group: &[Trained<'_>]) -> bool {
    let mut seeds: Vec<u64> = group.iter().map(|one| one.settings.seed).collect();
    seeds.sort_unstable();
    seeds.windows(2).any(|pair| pair[0] == pair[1])
}

impl SeedGroup {
    fn of(group: &[Trained<'_>], seed: u64) -> Self {
        let first = group[0].settings;
        let same = group.iter().all(|one| one.settings.updates == first.updates);
        let mut rows = Vec::new();
        // Every training was measured on the same trajectories, so the first one has all tasks and kinds.
        for report in group[0].tasks {
            let kinds = report.kinds.iter().map(|kind| Some(kind.kind.as_str()));
            for kind in std::iter::once(None).chain(kinds) {
                let measures = Measure::COMPARED.into_iter();
                rows.extend(
                    measures.filter_map(|measure| SeedRow::of(group, &report.task, kind, measure, seed)),
                );
            }
        }
        Self {
            label: format!("{:?}", first.model.kind).to_lowercase(),
            kind: first.model.kind,
            updates: same.then_some(first.updates),
            seeds: group.iter().map(|one| one.settings.seed).collect(),
            members: group.iter().map(|one| one.name.to_owned()).collect(),
            rows,
        }
    }
}

impl SeedRow {
    /// None where a training has no such value: then the seeds would not be those of the group.
    fn of(
        group: &[Trained<'_>],
        task: &str,
        kind: Option<&str>,
        measure: Measure,
        seed: u64,
    ) -> Option<Self> {
        let value = |one: &Trained<'_>| {
            let report = one.tasks.iter().find(|report| report.task == task)?;
            match kind {
                None => report.imagined.get(&measure)?.mean,
                Some(kind) => {
                    report.kinds.iter().find(|found| found.kind == kind)?.imagined.get(&measure)?.mean
                }
            }
        };
        let values: Vec<f64> = group.iter().map(value).collect::<Option<_>>()?;
        let (mean, std) = mean_and_std(values.iter().copied())?;
        let interval = mean_over_seeds(&values, seed);
        Some(Self {
            task: task.to_owned(),
            kind: kind.map(str::to_owned),
            measure,
            values,
            mean,
            std,
            interval,
        })
    }
}

/// The kind of model says it where there is one group of a kind; else also the updates, else also a number.
fn label(groups: &mut [SeedGroup]) {
    let count = |groups: &[SeedGroup]| {
        let mut found: BTreeMap<String, usize> = BTreeMap::new();
        groups.iter().for_each(|group| *found.entry(group.label.clone()).or_default() += 1);
        found
    };
    let of_kind = count(groups);
    for group in groups.iter_mut().filter(|group| of_kind[&group.label] > 1) {
        if let Some(updates) = group.updates {
            group.label = format!("{} after {updates} updates", group.label);
        }
    }
    let (of_updates, mut number) = (count(groups), BTreeMap::<String, usize>::new());
    for group in groups.iter_mut().filter(|group| of_updates[&group.label] > 1) {
        let number = number.entry(group.label.clone()).or_default();
        *number += 1;
        group.label = format!("{} ({number}: {})", group.label, group.members[0]);
    }
}

fn pairs(groups: &[SeedGroup]) -> Vec<(&SeedGroup, &SeedGroup)> {
    let of = |kind: ModelKind| groups.iter().filter(move |group| group.kind == kind);
    let both: Vec<_> = of(ModelKind::Rcwm)
        .flat_map(|ours| of(ModelKind::Vanilla).map(move |theirs| (ours, theirs)))
        .collect();
    let same: Vec<_> = both.iter().filter(|(ours, theirs)| ours.updates == theirs.updates).copied().collect();
    match groups.split_first() {
        _ if !same.is_empty() => same,
        Some((first, later)) if both.is_empty() => later.iter().map(|group| (group, first)).collect(),
        _ => both,
    }
}

fn compared(ours: &SeedGroup, theirs: &SeedGroup, seed: u64) -> Vec<Comparison> {
    let of = |row: &SeedRow| {
        let same = |other: &&SeedRow| {
            (&other.task, &other.kind, other.measure) == (&row.task, &row.kind, row.measure)
        };
        let other = theirs.rows.iter().find(same)?;
        Some(Comparison {
            task: row.task.clone(),
            kind: row.kind.clone(),
            measure: row.measure,
            model: ours.label.clone(),
            against: theirs.label.clone(),
            ratio: Some(row.mean / other.mean).filter(|ratio| ratio.is_finite())?,
            interval: interval_over_seeds(&row.values, &other.values, |a, b| a / b, seed),
            over: Over::Seeds(ours.seeds.len(), theirs.seeds.len()),
        })
    };
    ours.rows.iter().filter_map(of).collect()
}

#[cfg(test)]
mod tests {
    use rcwm_models::settings::{ModelSettings, Preset};

    use super::*;
    use crate::evaluation::Series;

    fn settings(kind: ModelKind, seed: u64, updates: u64) -> CheckpointSettings {
        CheckpointSettings {
            format: crate::checkpoint::FORMAT,
            preset: "debug".into(),
            seed,
            updates,
            data: "data".into(),
            cpu_seconds: 0.0,
            weights_sha256: String::new(),
            model: ModelSettings::preset(Preset::Debug, kind),
        }
    }

    fn report(error: f64) -> Vec<TaskReport> {
        let series =
            Series { mean: Some(error), std: None, interval: None, step_mean: vec![], step_std: vec![] };
        vec![TaskReport {
            task: "hammer".into(),
            trajectories: 1,
            episodes: 1,
            imagined: BTreeMap::from([(Measure::RobotError, series)]),
            posterior: BTreeMap::new(),
            kinds: Vec::new(),
            response: None,
            attention: None,
        }]
    }

    fn over(all: &[(ModelKind, u64, u64, f64)]) -> OverSeeds {
        let all: Vec<_> = all
            .iter()
            .map(|(kind, seed, updates, error)| {
                (format!("{kind:?}-{seed}-{updates}"), settings(*kind, *seed, *updates), report(*error))
            })
            .collect();
        let trained: Vec<_> =
            all.iter().map(|(name, settings, tasks)| Trained { name, settings, tasks }).collect();
        OverSeeds::of(&trained, 0)
    }

    use ModelKind::{Rcwm, Vanilla};

    #[test]
    fn rcwm_is_compared_with_vanilla_over_seeds() {
        let errors = [0.9, 1.0, 1.1, 0.8, 1.2];
        let ours = errors.iter().enumerate().map(|(seed, error)| (Rcwm, seed as u64, 10, *error));
        let theirs = (0..5).map(|seed| (Vanilla, seed, 10, 2.0));
        let found = over(&theirs.chain(ours).collect::<Vec<_>>());
        assert_eq!(found.groups.len(), 2);
        assert_eq!(found.groups[1].rows[0].values, errors);
        let [comparison] = found.comparisons.as_slice() else { panic!("{found:?}") };
        let interval = comparison.interval.unwrap();
        assert!((comparison.ratio - 0.5).abs() < 1e-9 && interval.low > 0.4 && interval.high < 0.6);
        assert!(interval.low < 0.5 && interval.high > 0.5);
        let line = comparison.to_string();
        assert!(line.starts_with("hammer: robot error of rcwm is 0.500 (95% 0.4"), "{line}");
        assert!(line.ends_with("times that of vanilla, over 5 and 5 training seeds"), "{line}");
    }

    #[test]
    fn fewer_than_five_seeds_are_no_result_and_say_so() {
        let found = over(&[(Rcwm, 0, 10, 1.0), (Rcwm, 1, 10, 3.0), (Vanilla, 0, 10, 2.0)]);
        let line = found.comparisons[0].to_string();
        assert!(line.contains("is 1.000 (95% 0.500 to 1.500)"), "{line}");
        assert!(line.ends_with("over 2 and 1 training seeds; fewer than 5: no result yet"), "{line}");
    }

    #[test]
    fn a_seed_that_comes_twice_is_told_apart_by_updates_or_left_out() {
        let mut all = Vec::new();
        for seed in 0..2 {
            all.extend([
                (Rcwm, seed, 10, 1.0),
                (Rcwm, seed, 50, 0.5),
                (Vanilla, seed, 10, 2.0),
                (Vanilla, seed, 50, 1.0),
            ]);
        }
        let found = over(&all);
        let labels: Vec<&str> = found.groups.iter().map(|group| group.label.as_str()).collect();
        let expected = [
            "rcwm after 10 updates",
            "rcwm after 50 updates",
            "vanilla after 10 updates",
            "vanilla after 50 updates",
        ];
        assert_eq!(labels, expected);
        let pairs: Vec<_> =
            found.comparisons.iter().map(|c| (c.model.as_str(), c.against.as_str())).collect();
        assert_eq!(pairs, [(expected[0], expected[2]), (expected[1], expected[3])], "as many updates each");
        let twice =
            over(&[(Rcwm, 0, 10, 1.0), (Rcwm, 0, 10, 2.0), (Vanilla, 0, 10, 2.0), (Vanilla, 1, 10, 2.0)]);
        assert!(twice.notes[0].contains("a training seed comes twice"), "{twice:?}");
        assert!(twice.groups.len() == 1 && twice.comparisons.is_empty());
    }

    #[test]
    fn one_training_of_each_is_no_group() {
        let found = over(&[(Rcwm, 0, 10, 1.0), (Vanilla, 0, 10, 2.0)]);
        assert_eq!(found, OverSeeds::default());
    }

    #[test]
    fn without_a_baseline_later_groups_are_compared_with_the_first() {
        let found = over(&[(Rcwm, 0, 10, 1.0), (Rcwm, 1, 10, 1.0), (Rcwm, 0, 50, 0.5), (Rcwm, 1, 50, 0.5)]);
        assert_eq!(found.comparisons[0].ratio, 0.5);
        assert_eq!(found.comparisons[0].against, "rcwm after 10 updates");
    }
}
