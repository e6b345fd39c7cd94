//! How surprised the branches were.

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::policy::Surprise;

/// Largest surprise told apart, in thousandths of a nat.
const MILLINATS_MAX: u64 = 1_000_000_000;

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

/// Percentiles over the ticks with an observation that were not the first of an episode, of the branches that there were.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SurpriseReport {
    /// How many ticks.
    pub count: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<BranchSurprise>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub environment: Option<BranchSurprise>,
    /// Of a world model of one branch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dynamics: Option<BranchSurprise>,
}

/// Histograms of the branches: a policy of another kind may take over.
pub(super) struct SurpriseTelemetry {
    robot: Histogram<u64>,
    environment: Histogram<u64>,
    dynamics: Histogram<u64>,
}

impl SurpriseTelemetry {
    pub(super) fn new() -> Self {
        let empty =
            Histogram::new_with_bounds(1, MILLINATS_MAX, 3).expect("the bounds are constants that fit");
        Self { robot: empty.clone(), environment: empty.clone(), dynamics: empty }
    }

    pub(super) fn record(&mut self, surprise: &Surprise) {
        // A cast of NaN or of a negative number gives 0.
        let record = |to: &mut Histogram<u64>, nats: f32| to.saturating_record((nats * 1e3) as u64);
        match *surprise {
            Surprise::Rcwm { robot, environment } => {
                record(&mut self.robot, robot);
                record(&mut self.environment, environment);
            }
            Surprise::Dreamer(dynamics) => record(&mut self.dynamics, dynamics),
        }
    }

    pub(super) fn report(&self) -> Option<SurpriseReport> {
        let branch = |histogram: &Histogram<u64>| {
            let nats = |millinats: u64| millinats as f64 / 1e3;
            (!histogram.is_empty()).then(|| BranchSurprise {
                p50_nats: nats(histogram.value_at_quantile(0.5)),
                p99_nats: nats(histogram.value_at_quantile(0.99)),
                max_nats: nats(histogram.max()),
            })
        };
        let count = self.robot.len() + self.dynamics.len();
        (count > 0).then(|| SurpriseReport {
            count,
            robot: branch(&self.robot),
            environment: branch(&self.environment),
            dynamics: branch(&self.dynamics),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_in_nats_and_of_the_branches_that_there_were() {
        let mut telemetry = SurpriseTelemetry::new();
        assert_eq!(telemetry.report(), None);
        for tenths in 1..=100 {
            telemetry.record(&Surprise::Rcwm { robot: tenths as f32 / 10.0, environment: 0.5 });
        }
        let report = telemetry.report().unwrap();
        let (robot, environment) = (report.robot.unwrap(), report.environment.unwrap());
        assert_eq!((report.count, report.dynamics), (100, None));
        assert!((robot.p50_nats - 5.0).abs() < 0.02 && (robot.max_nats - 10.0).abs() < 0.02);
        assert!((environment.p99_nats - 0.5).abs() < 0.01);
        let mut telemetry = SurpriseTelemetry::new();
        telemetry.record(&Surprise::Dreamer(3.0));
        let report = telemetry.report().unwrap();
        assert!(report.robot.is_none() && report.environment.is_none());
        assert!((report.dynamics.unwrap().max_nats - 3.0).abs() < 0.01);
    }
}
