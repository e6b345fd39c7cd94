use std::collections::BTreeMap;

use image::RgbImage;
use rcwm_models::settings::ModelKind;
use serde::Serialize;

use super::{Answer, Comparison, Measure, OpenLoopSettings, OverSeeds, TaskReport};
use crate::plots::{self, PlotError};

/// Pixels of one panel of a plot.
const PANEL: (u32, u32) = (460, 320);
const COLUMNS: usize = 4;

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
    /// Seed of its training.
    pub seed: u64,
    /// Updates behind it.
    pub updates: u64,
    pub tasks: Vec<TaskReport>,
}

/// Everything that was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OpenLoopReport {
    /// How.
    pub settings: OpenLoopSettings,
    /// What the numbers mean.
    pub measures: BTreeMap<Measure, &'static str>,
    /// The same of the response.
    pub answers: BTreeMap<Answer, &'static str>,
    /// The models in the order they were given.
    pub models: Vec<ModelReport>,
    /// Every later model against the first, over episodes.
    pub comparisons: Vec<Comparison>,
    /// Sets of models that differ in the seed of their training only, and these against each other.
    pub over_seeds: OverSeeds,
}

impl OpenLoopReport {
    /// A report without models yet.
    #[must_use]
    pub fn new(settings: OpenLoopSettings) -> Self {
        let measures = Measure::ALL.into_iter().map(|measure| (measure, measure.definition())).collect();
        let answers = Answer::ALL.into_iter().map(|answer| (answer, answer.definition())).collect();
        let (models, comparisons, over_seeds) = (Vec::new(), Vec::new(), OverSeeds::default());
        Self { settings, measures, answers, models, comparisons, over_seeds }
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
