//! How surprised the two branches were, and how much of it is borne.

use hdrhistogram::Histogram;
use serde::Serialize;

use super::Cause;
use crate::policy::Surprise;

/// Largest surprise told apart, in thousandths of a nat.
const MILLINATS_MAX: u64 = 1_000_000_000;

/// Largest surprise that is borne, in nats; none for any.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct SurpriseLimits {
    /// Of the robot branch.
    pub robot_max: Option<f32>,
    /// Of the environment branch.
    pub environment_max: Option<f32>,
}

impl SurpriseLimits {
    /// The limit that a surprise is over, the robot's first.
    #[must_use]
    pub fn exceeded_by(&self, surprise: &Surprise) -> Option<Cause> {
        // Written so that NaN is over every limit.
        let over = |value: f32, max: Option<f32>| {
            max.is_some_and(|max| !matches!(value.partial_cmp(&max), Some(order) if order.is_le()))
        };
        if over(surprise.robot, self.robot_max) {
            Some(Cause::RobotSurprise)
        } else if over(surprise.environment, self.environment_max) {
            Some(Cause::EnvironmentSurprise)
        } else {
            None
        }
    }
}

/// Percentiles of a branch's surprise, in nats.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BranchSurprise {
    /// Median.
    pub p50_nats: f64,
    /// 99 of 100 are at most this.
    pub p99_nats: f64,
    /// Largest.
    pub max_nats: f64,
}

/// Percentiles of both, over the ticks with an observation that were not the first of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SurpriseReport {
    /// How many ticks.
    pub count: u64,
    pub robot: BranchSurprise,
    pub environment: BranchSurprise,
}

/// Histograms of both.
pub(super) struct SurpriseTelemetry {
    robot: Histogram<u64>,
    environment: Histogram<u64>,
}

impl SurpriseTelemetry {
    pub(super) fn new() -> Self {
        let empty =
            Histogram::new_with_bounds(1, MILLINATS_MAX, 3).expect("the bounds are constants that fit");
        Self { robot: empty.clone(), environment: empty }
    }

    pub(super) fn record(&mut self, surprise: &Surprise) {
        // A cast of NaN or of a negative number gives 0.
        self.robot.saturating_record((surprise.robot * 1e3) as u64);
        self.environment.saturating_record((surprise.environment * 1e3) as u64);
    }

    pub(super) fn report(&self) -> Option<SurpriseReport> {
        let branch = |histogram: &Histogram<u64>| {
            let nats = |millinats: u64| millinats as f64 / 1e3;
            BranchSurprise {
                p50_nats: nats(histogram.value_at_quantile(0.5)),
                p99_nats: nats(histogram.value_at_quantile(0.99)),
                max_nats: nats(histogram.max()),
            }
        };
        let (robot, environment) = (branch(&self.robot), branch(&self.environment));
        (!self.robot.is_empty()).then(|| SurpriseReport { count: self.robot.len(), robot, environment })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_branch_has_its_own_limit_and_no_number_passes_one() {
        let limits = SurpriseLimits { robot_max: Some(2.0), environment_max: Some(5.0) };
        let exceeded = |robot, environment| limits.exceeded_by(&Surprise { robot, environment });
        assert_eq!(exceeded(2.0, 5.0), None);
        assert_eq!(exceeded(2.1, 9.0), Some(Cause::RobotSurprise));
        assert_eq!(exceeded(0.0, 5.1), Some(Cause::EnvironmentSurprise));
        assert_eq!(exceeded(f32::NAN, 0.0), Some(Cause::RobotSurprise));
        let none = SurpriseLimits::default();
        assert_eq!(none.exceeded_by(&Surprise { robot: 1e9, environment: f32::INFINITY }), None);
    }

    #[test]
    fn percentiles_are_in_nats() {
        let mut telemetry = SurpriseTelemetry::new();
        assert_eq!(telemetry.report(), None);
        for tenths in 1..=100 {
            telemetry.record(&Surprise { robot: tenths as f32 / 10.0, environment: 0.5 });
        }
        let report = telemetry.report().unwrap();
        assert_eq!(report.count, 100);
        assert!((report.robot.p50_nats - 5.0).abs() < 0.02 && (report.robot.max_nats - 10.0).abs() < 0.02);
        assert!((report.environment.p99_nats - 0.5).abs() < 0.01);
    }
}
