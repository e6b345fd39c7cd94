use std::collections::BTreeMap;
use std::fmt::Write as _;

use image::RgbImage;
use rcwm_models::settings::ModelKind;
use serde::{Deserialize, Serialize};

use super::statistics::{Bootstrap, Interval, mean_and_std};
use super::{Measure, Measured, OpenLoopSettings, TaskTrajectories, Trace};
use crate::plots::{self, Band, COLOURS, Line, Panel, PlotError, Scale};

/// Pixels of one panel of a plot.
const PANEL: (u32, u32) = (460, 320);
const COLUMNS: usize = 4;

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

/// A model on a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskReport {
    /// The task.
    pub task: String,
    /// Trajectories measured on.
    pub trajectories: usize,
    /// Episodes they are of.
    pub episodes: usize,
    /// By measure, of imagined states.
    pub imagined: BTreeMap<Measure, Series>,
    /// By measure, of posterior states at the same steps.
    pub posterior: BTreeMap<Measure, Series>,
}

/// A model on every task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelReport {
    /// What it is called in tables and plots.
    pub name: String,
    /// Where it lies.
    pub checkpoint: String,
    /// RCWM or vanilla.
    pub kind: ModelKind,
    /// Sizes it started from.
    pub preset: String,
    /// Updates behind it.
    pub updates: u64,
    /// Its tasks.
    pub tasks: Vec<TaskReport>,
}

/// Two models on the same trajectories of a task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// The task.
    pub task: String,
    /// The model.
    pub model: String,
    /// What it is compared with.
    pub against: String,
    /// Its mean robot dynamics error, divided by the other's.
    pub ratio: f64,
    /// 95% bootstrap interval of the ratio; the same trajectories are drawn for both.
    pub interval: Option<Interval>,
}

/// Everything that was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OpenLoopReport {
    /// How.
    pub settings: OpenLoopSettings,
    /// What the numbers mean.
    pub measures: BTreeMap<Measure, &'static str>,
    /// The models in the order they were given.
    pub models: Vec<ModelReport>,
    /// Every later model against the first.
    pub comparisons: Vec<Comparison>,
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

fn drawn_mean(means: &[Option<f64>], draw: &[usize]) -> Option<f64> {
    mean_and_std(draw.iter().filter_map(|trajectory| means[*trajectory])).map(|(mean, _)| mean)
}

impl TaskReport {
    /// Sums a task up.
    #[must_use]
    pub fn of(task: &TaskTrajectories, measured: &Measured, seed: u64) -> Self {
        // The same draws for every model.
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

impl Comparison {
    /// A model (its name, what was measured) against another on the same trajectories, by robot dynamics error; none where
    /// either has no error at all.
    #[must_use]
    pub fn of(
        task: &TaskTrajectories,
        (model, measured): (&str, &Measured),
        (against, other): (&str, &Measured),
        seed: u64,
    ) -> Option<Self> {
        let (ours, theirs) = (measured.robot_errors(), other.robot_errors());
        Self::of_means(&task.task, (model, &ours), (against, &theirs), &task.numbers(), seed)
    }

    /// The same of each trajectory's mean robot dynamics error; `episodes` says which episode each trajectory is of.
    #[must_use]
    pub fn of_means(
        task: &str,
        (model, ours): (&str, &[Option<f64>]),
        (against, theirs): (&str, &[Option<f64>]),
        episodes: &[usize],
        seed: u64,
    ) -> Option<Self> {
        let ratio = |draw: &[usize]| {
            Some(drawn_mean(ours, draw)? / drawn_mean(theirs, draw)?).filter(|ratio| ratio.is_finite())
        };
        Some(Self {
            task: task.to_owned(),
            model: model.to_owned(),
            against: against.to_owned(),
            ratio: ratio(&(0..ours.len()).collect::<Vec<_>>())?,
            interval: Bootstrap::new(episodes, seed).interval(ratio),
        })
    }
}

impl OpenLoopReport {
    /// A report without models yet.
    #[must_use]
    pub fn new(settings: OpenLoopSettings) -> Self {
        let measures = Measure::ALL.into_iter().map(|measure| (measure, measure.definition())).collect();
        Self { settings, measures, models: Vec::new(), comparisons: Vec::new() }
    }

    /// The summary for people.
    #[must_use]
    pub fn table(&self) -> String {
        let name_width = self.models.iter().map(|model| model.name.len()).max().unwrap_or(0).max(5);
        let mut text = format!(
            "{} steps of context, {} imagined; pictures in [0, 1]; means, and the 95% interval of the first\n",
            self.settings.context, self.settings.imagined
        );
        let _ = writeln!(
            text,
            "{:18} {:name_width$} {:>27} {:>10} {:>15} {:>15} {:>10}",
            "task", "model", "robot error x1000", "on robot", "mask IoU", "reconstruction", "reward"
        );
        let _ = writeln!(
            text,
            "{:18} {:name_width$} {:>27} {:>10} {:>15} {:>15} {:>10}",
            "", "", "", "x1000", "imagined/seen", "x1000", "error"
        );
        for model in &self.models {
            for task in &model.tasks {
                let _ = writeln!(text, "{}", table_row(&model.name, name_width, task));
            }
        }
        for comparison in &self.comparisons {
            let Comparison { task, model, against, ratio, interval } = comparison;
            let range = interval.map_or_else(String::new, |i| format!(" ({:.3} to {:.3})", i.low, i.high));
            let _ =
                writeln!(text, "{task}: robot error of {model} is {ratio:.3}{range} times that of {against}");
        }
        text
    }

    /// One measure over the imagined steps: a panel a task, a line a model, with a band of one standard deviation.
    ///
    /// # Errors
    /// Those of drawing.
    pub fn plot(&self, measure: Measure) -> Result<RgbImage, PlotError> {
        let tasks = self.models.first().map_or(0, |model| model.tasks.len());
        let panel = |index: usize| {
            let models = self.models.iter().map(|model| (model.name.as_str(), &model.tasks[index]));
            TaskReport::panel(&models.collect::<Vec<_>>(), measure)
        };
        plots::draw(&(0..tasks).map(panel).collect::<Vec<_>>(), COLUMNS, PANEL)
    }
}

fn table_row(model: &str, name_width: usize, task: &TaskReport) -> String {
    let mean = |series: &Series, scale: f64, digits: usize| {
        series.mean.map_or_else(|| "-".to_owned(), |mean| format!("{:.digits$}", mean * scale))
    };
    let imagined = |measure: Measure| &task.imagined[&measure];
    let error = imagined(Measure::RobotError);
    let range =
        error.interval.map_or_else(String::new, |i| format!(" ({:.3} to {:.3})", i.low * 1e3, i.high * 1e3));
    let overlap = [imagined(Measure::MaskIou), &task.posterior[&Measure::MaskIou]].map(|x| mean(x, 1.0, 3));
    format!(
        "{:18} {model:name_width$} {:>27} {:>10} {:>15} {:>15} {:>10}",
        task.task,
        mean(error, 1e3, 3) + &range,
        mean(imagined(Measure::RobotErrorOnRobot), 1e3, 2),
        overlap.join("/"),
        mean(imagined(Measure::ReconstructionError), 1e3, 2),
        mean(imagined(Measure::RewardError), 1.0, 3),
    )
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
