//! Latency histograms, one per stage, and files of them at the end of a run.
//!
//! Times are kept in nanoseconds with three significant digits up to one minute, so that a recording never allocates and never
//! fails; they are reported in microseconds.
//!
//! | file | holds |
//! | --- | --- |
//! | `hgrm` | HdrHistogram's percentile files, for the usual plotters |
//! | `files` | the options that ask for them |

mod files;
mod hgrm;
mod recent;

pub use files::LatencyFiles;
pub use recent::RECENT_MAX;

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::policy::STAGES;
use recent::Recent;

/// Longest time told apart, in ns.
const TIME_NS_MAX: u64 = 60_000_000_000;

/// What is timed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Observation scheduled -> published: the simulator's own lateness (real time).
    PublishLag,
    /// Observation published -> received.
    Receive,
    /// Encoder; of `rcwm` what both branches share.
    Encoder,
    /// Robot branch.
    Robot,
    /// Interaction model.
    Interaction,
    /// Environment branch.
    Environment,
    /// The one branch of `dreamer`.
    Dynamics,
    /// All of `recurrent`.
    Policy,
    Actor,
    /// Observation received -> action published.
    Tick,
    /// Observation published -> action published.
    EndToEnd,
    /// Observation scheduled -> action published, ticks without an observation or an answer included (real time).
    FromSchedule,
    /// A tick without an observation: found overdue -> action published.
    Imagine,
    /// Work ahead, in the idle time after an action was sent.
    Ahead,
    /// Getting ready, shortly before an observation is expected.
    Ready,
}

impl Stage {
    /// All stages, in the order of a tick.
    pub const ALL: [Self; 15] = [
        Self::PublishLag,
        Self::Receive,
        Self::Encoder,
        Self::Robot,
        Self::Interaction,
        Self::Environment,
        Self::Dynamics,
        Self::Policy,
        Self::Actor,
        Self::Tick,
        Self::EndToEnd,
        Self::FromSchedule,
        Self::Imagine,
        Self::Ahead,
        Self::Ready,
    ];

    /// The stages of the policy, in the order of [`STAGES`].
    pub const POLICY: [Self; STAGES.len()] = [
        Self::Encoder,
        Self::Robot,
        Self::Interaction,
        Self::Environment,
        Self::Dynamics,
        Self::Policy,
        Self::Actor,
    ];

    /// The name in tables and files.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::PublishLag => "publish_lag",
            Self::Receive => "receive",
            Self::Encoder => "encoder",
            Self::Robot => "robot",
            Self::Interaction => "interaction",
            Self::Environment => "environment",
            Self::Dynamics => "dynamics",
            Self::Policy => "policy",
            Self::Actor => "actor",
            Self::Tick => "tick",
            Self::EndToEnd => "end_to_end",
            Self::FromSchedule => "from_schedule",
            Self::Imagine => "imagine",
            Self::Ahead => "ahead",
            Self::Ready => "ready",
        }
    }
}

/// One histogram per stage.
#[derive(Clone)]
pub struct Telemetry {
    histograms: [Histogram<u64>; Stage::ALL.len()],
    recent: Recent,
}

impl Default for Telemetry {
    fn default() -> Self {
        Self::new()
    }
}

impl Telemetry {
    /// Empty histograms.
    #[must_use]
    pub fn new() -> Self {
        let empty = Histogram::new_with_bounds(1, TIME_NS_MAX, 3).expect("the bounds are constants that fit");
        Self { histograms: std::array::from_fn(|_| empty.clone()), recent: Recent::new() }
    }

    /// Records a time; one over a minute counts as a minute.
    pub fn record(&mut self, stage: Stage, time_ns: u64) {
        self.histograms[stage as usize].saturating_record(time_ns);
        self.recent.note(stage, time_ns);
    }

    /// Every time recorded for a stage, in ns.
    #[must_use]
    pub fn histogram(&self, stage: Stage) -> &Histogram<u64> {
        &self.histograms[stage as usize]
    }

    /// Recordings so far, of all stages.
    #[must_use]
    pub fn recorded(&self) -> u64 {
        self.recent.noted()
    }

    /// The recordings from number `first` on, in ns; at most the last [`RECENT_MAX`] are remembered.
    pub fn recorded_since(&self, first: u64) -> impl Iterator<Item = (Stage, u64)> {
        self.recent.since(first)
    }

    /// Records the stages of the policy; what was worked ahead took no time in the tick, and is left out.
    pub fn record_policy(&mut self, stage_ns: &[u64]) {
        for (stage, time_ns) in Stage::POLICY.into_iter().zip(stage_ns).filter(|(_, time_ns)| **time_ns > 0) {
            self.record(stage, *time_ns);
        }
    }

    /// What was recorded for a stage.
    #[must_use]
    pub fn latency(&self, stage: Stage) -> Latency {
        let histogram = &self.histograms[stage as usize];
        let us = |time_ns: u64| time_ns as f64 / 1e3;
        let at = |quantile: f64| us(histogram.value_at_quantile(quantile));
        Latency {
            stage,
            count: histogram.len(),
            p50_us: at(0.5),
            p99_us: at(0.99),
            p999_us: at(0.999),
            max_us: us(histogram.max()),
        }
    }

    /// All stages that have recorded anything.
    #[must_use]
    pub fn latencies(&self) -> Vec<Latency> {
        Stage::ALL.map(|stage| self.latency(stage)).into_iter().filter(|latency| latency.count > 0).collect()
    }
}

/// Percentiles of one stage, in microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Latency {
    /// What was timed.
    pub stage: Stage,
    /// How often.
    pub count: u64,
    /// Median.
    pub p50_us: f64,
    /// 99 of 100 are at most this.
    pub p99_us: f64,
    /// 999 of 1000 are at most this.
    pub p999_us: f64,
    /// Longest.
    pub max_us: f64,
}

/// A table of percentiles.
#[must_use]
pub fn table(latencies: &[Latency]) -> String {
    let mut text = format!(
        "  {:<13} {:>9} {:>10} {:>10} {:>10} {:>10}\n",
        "latency, us", "count", "p50", "p99", "p99.9", "max"
    );
    for row in latencies {
        let Latency { stage, count, p50_us, p99_us, p999_us, max_us } = row;
        text += &format!(
            "  {:<13} {count:>9} {p50_us:>10.1} {p99_us:>10.1} {p999_us:>10.1} {max_us:>10.1}\n",
            stage.as_str()
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_recorded_times() {
        let mut telemetry = Telemetry::new();
        for time_us in 1..=1000 {
            telemetry.record(Stage::Tick, time_us * 1000);
        }
        let latency = telemetry.latency(Stage::Tick);
        let near = |found: f64, expected: f64| (found / expected - 1.0).abs() < 2e-3;
        assert_eq!(latency.count, 1000);
        assert!(near(latency.p50_us, 500.0) && near(latency.p99_us, 990.0), "{latency:?}");
        assert!(near(latency.p999_us, 999.0) && near(latency.max_us, 1000.0), "{latency:?}");
        assert_eq!(telemetry.latencies().len(), 1);
    }

    #[test]
    fn times_out_of_range_are_kept_at_the_border() {
        let mut telemetry = Telemetry::new();
        telemetry.record(Stage::Receive, 0);
        telemetry.record(Stage::Receive, u64::MAX);
        let latency = telemetry.latency(Stage::Receive);
        assert_eq!(latency.count, 2);
        assert!(latency.max_us >= 59e6, "{latency:?}");
    }

    #[test]
    fn the_stages_of_the_policy_are_named_as_its_parts() {
        assert_eq!(Stage::POLICY.map(Stage::as_str), STAGES.map(rcwm_models::bundle::PartName::as_str));
    }

    #[test]
    fn every_stage_has_its_own_histogram() {
        for (index, stage) in Stage::ALL.into_iter().enumerate() {
            assert_eq!(stage as usize, index);
        }
    }
}
