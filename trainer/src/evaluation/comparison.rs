use std::fmt;

use serde::Serialize;

use super::statistics::{Bootstrap, Interval, SEEDS_LEAST};
use super::task_report::drawn_mean;
use super::{Measure, Measured, TaskTrajectories};

/// What an interval is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Over {
    /// Episodes of one training of each: says nothing about another training.
    Episodes,
    /// Training seeds: how many the model has, and how many what it is compared with.
    Seeds(usize, usize),
}

/// Two models, or two sets of models, on the same trajectories of a task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    pub task: String,
    /// Kind of script; none for all.
    pub kind: Option<String>,
    /// What is compared.
    pub measure: Measure,
    pub model: String,
    /// What it is compared with.
    pub against: String,
    /// Its mean, divided by the other's.
    pub ratio: f64,
    /// 95% bootstrap interval of the ratio. Over episodes the same are drawn for both, over seeds each set's own.
    pub interval: Option<Interval>,
    /// What the interval is over.
    pub over: Over,
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
            kind: None,
            measure: Measure::RobotError,
            model: model.to_owned(),
            against: against.to_owned(),
            ratio: ratio(&(0..ours.len()).collect::<Vec<_>>())?,
            interval: Bootstrap::new(episodes, seed).interval(ratio),
            over: Over::Episodes,
        })
    }
}

impl fmt::Display for Over {
    /// Also whether that is enough to say something.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Episodes => write!(f, "over episodes of one training each"),
            Self::Seeds(ours, theirs) => {
                write!(f, "over {ours} and {theirs} training seeds")?;
                if ours.min(theirs) < &SEEDS_LEAST {
                    write!(f, "; fewer than {SEEDS_LEAST}: no result yet")?;
                }
                Ok(())
            }
        }
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { task, kind, measure, model, against, ratio, interval, over } = self;
        let kind = kind.as_ref().map_or_else(String::new, |kind| format!(", {kind}"));
        let measure = measure.name().replace('_', " ");
        let range = interval.map_or_else(String::new, |i| format!(" (95% {:.3} to {:.3})", i.low, i.high));
        write!(f, "{task}{kind}: {measure} of {model} is {ratio:.3}{range} times that of {against}, {over}")
    }
}
