//! What was measured on one task, summed up.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::statistics::{Bootstrap, Interval, mean_and_std};
use super::{AttentionSpread, Measure, Measured, OpenLoopSettings, Response, TaskTrajectories, Trace};
use crate::plots::{self, Band, COLOURS, Line, Panel, Scale};

/// One measure over a task's trajectories.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Series {
    /// Mean over all steps and trajectories.
    pub mean: Option<f64>,
    /// Standard deviation, over trajectories, of their means over steps.
    pub std: Option<f64>,
    /// 95% bootstrap interval of the mean; episodes are drawn.
    pub interval: Option<Interval>,
    /// Mean over trajectories at every step after the context.
    pub step_mean: Vec<Option<f64>>,
    /// Standard deviation over trajectories at every step.
    pub step_std: Vec<Option<f64>>,
}

/// One measure over some trajectories.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Mean over trajectories of their means over steps.
    pub mean: Option<f64>,
    /// Standard deviation over trajectories.
    pub std: Option<f64>,
    /// 95% bootstrap interval of the mean; episodes are drawn.
    pub interval: Option<Interval>,
}

/// A model on a task's trajectories of one kind of script.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KindReport {
    /// Who decided: `expert`, `mixed`, `random`, `pushed`, or `other` where the names of the episodes' files do not say.
    pub kind: String,
    /// Trajectories measured on.
    pub trajectories: usize,
    /// Episodes they are of.
    pub episodes: usize,
    /// By measure, of imagined states.
    pub imagined: BTreeMap<Measure, Spread>,
}

/// A model on a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskReport {
    pub task: String,
    /// Trajectories measured on.
    pub trajectories: usize,
    /// Episodes they are of.
    pub episodes: usize,
    /// By measure, of imagined states.
    pub imagined: BTreeMap<Measure, Series>,
    /// By measure, of posterior states at the same steps.
    pub posterior: BTreeMap<Measure, Series>,
    /// The same trajectories by kind of script.
    #[serde(default)]
    pub kinds: Vec<KindReport>,
    /// What other actions change in the imagined pictures.
    #[serde(default)]
    pub response: Option<Response>,
    /// How the attention is spread at the imagined states; none for a model without interaction.
    #[serde(default)]
    pub attention: Option<AttentionSpread>,
}

impl Series {
    fn of(traces: &[Trace], measure: Measure, bootstrap: &Bootstrap) -> Self {
        let means: Vec<Option<f64>> = traces.iter().map(|trace| trace.mean(measure)).collect();
        let whole = mean_and_std(means.iter().flatten().copied());
        let steps = traces.first().map_or(0, |trace| trace.of(measure).len());
        let at = |step: usize| mean_and_std(traces.iter().filter_map(|trace| trace.of(measure)[step]));
        let by_step: Vec<_> = (0..steps).map(at).collect();
        Self {
            mean: whole.map(|(mean, _)| mean),
            std: whole.map(|(_, std)| std),
            interval: bootstrap.interval(|draw| drawn_mean(&means, draw)),
            step_mean: by_step.iter().map(|found| found.map(|(mean, _)| mean)).collect(),
            step_std: by_step.iter().map(|found| found.map(|(_, std)| std)).collect(),
        }
    }
}

impl Spread {
    /// Of the trajectories at some places, which the bootstrap draws from.
    fn of(means: &[Option<f64>], bootstrap: &Bootstrap) -> Self {
        let found = mean_and_std(means.iter().flatten().copied());
        Self {
            mean: found.map(|(mean, _)| mean),
            std: found.map(|(_, std)| std),
            interval: bootstrap.interval(|draw| drawn_mean(means, draw)),
        }
    }
}

impl KindReport {
    fn all(task: &TaskTrajectories, traces: &[Trace], seed: u64) -> Vec<Self> {
        let numbers = task.numbers();
        let of = |(kind, places): (&'static str, Vec<usize>)| {
            let mut episodes: Vec<usize> = places.iter().map(|place| numbers[*place]).collect();
            let bootstrap = Bootstrap::new(&episodes, seed);
            let means = |measure| places.iter().map(|place| traces[*place].mean(measure)).collect::<Vec<_>>();
            let imagined =
                Measure::ALL.into_iter().map(|measure| (measure, Spread::of(&means(measure), &bootstrap)));
            let (kind, trajectories, imagined) = (kind.to_owned(), places.len(), imagined.collect());
            episodes.sort_unstable();
            episodes.dedup();
            Self { kind, trajectories, episodes: episodes.len(), imagined }
        };
        task.kinds().into_iter().map(of).collect()
    }
}

pub(super) fn drawn_mean(means: &[Option<f64>], draw: &[usize]) -> Option<f64> {
    mean_and_std(draw.iter().filter_map(|trajectory| means[*trajectory])).map(|(mean, _)| mean)
}

impl TaskReport {
    /// Sums a task up; `settings` are those it was measured with.
    #[must_use]
    pub fn of(task: &TaskTrajectories, measured: &Measured, settings: &OpenLoopSettings) -> Self {
        // The same draws for every model.
        let (seed, other) = (settings.seed, settings.other_actions);
        let bootstrap = Bootstrap::new(&task.numbers(), seed);
        let all = |traces: &[Trace]| {
            Measure::ALL.iter().map(|measure| (*measure, Series::of(traces, *measure, &bootstrap))).collect()
        };
        Self {
            task: task.task.clone(),
            trajectories: task.chosen.len(),
            episodes: task.episodes(),
            imagined: all(&measured.imagined),
            posterior: all(&measured.posterior),
            kinds: KindReport::all(task, &measured.imagined, seed),
            response: other.and_then(|other| Response::of(&measured.differences, other, &bootstrap)),
            attention: measured.attention(),
        }
    }
}

impl TaskReport {
    /// One measure of several models, by name, over the imagined steps of a task: a line a model, with a band of one standard
    /// deviation over trajectories.
    #[must_use]
    pub fn panel(models: &[(&str, &Self)], measure: Measure) -> Panel {
        let lines = models.iter().zip(COLOURS.iter().cycle());
        Panel {
            title: models.first().map_or_else(String::new, |(_, report)| report.task.clone()),
            x_label: format!("imagined steps; {}", measure.title()),
            scale: Scale::Linear,
            lines: lines
                .map(|((name, report), colour)| line(name, *colour, &report.imagined[&measure]))
                .collect(),
            marks: Vec::new(),
        }
    }
}

fn line(name: &str, colour: plots::Colour, series: &Series) -> Line {
    // The first imagined step is step 1.
    let steps = || (1..).map(f64::from).zip(&series.step_mean);
    let band = steps().zip(&series.step_std).filter_map(|((step, mean), std)| {
        let (mean, std) = ((*mean)?, (*std)?);
        Some((step, (mean - std).max(0.0), mean + std))
    });
    Line {
        label: name.to_owned(),
        colour,
        points: steps().filter_map(|(step, mean)| Some((step, (*mean)?))).collect(),
        band: Some(Band { edges: band.collect() }),
        faint: false,
    }
}
