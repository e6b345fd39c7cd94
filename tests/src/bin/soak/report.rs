//! What a soak is summed up to.

use std::time::Duration;

use rcwm_tests::stream::PhaseReport;
use serde::Serialize;

use crate::Arguments;
use crate::samples::{Sample, median};

/// The parts of the time.
pub(crate) const TENTHS: [&str; 10] = ["1", "2", "3", "4", "5", "6", "7", "8", "9", "10"];
/// The tenth that is compared with the last: the first is the warm-up.
const FIRST_COUNTED: usize = 1;

#[derive(Debug, Serialize)]
pub(crate) struct Report {
    minutes_wanted: f64,
    rate_hz: f64,
    swap_every_s: f64,
    drift_max_mib: f64,
    /// Median of resident memory in the last tenth against that of the second, in MiB; none until there is a last tenth.
    drift_mib: Option<f64>,
    /// The same of anonymous memory.
    drift_anonymous_mib: Option<f64>,
    /// Resident memory from the second tenth on: slope of the straight line through it, in MiB an hour.
    slope_mib_per_h: Option<f64>,
    pub(crate) swaps_taken: u64,
    /// Swaps that were not taken, and what was said.
    pub(crate) swaps_wrong: Vec<String>,
    /// The stream, tenth by tenth.
    pub(crate) phases: Vec<PhaseReport>,
    pub(crate) samples: Vec<Sample>,
    /// The run's own summary.
    run: serde_json::Value,
    /// What was left in shared memory.
    pub(crate) leftovers: Vec<String>,
}

impl Report {
    pub(crate) fn new(arguments: &Arguments) -> Self {
        Self {
            minutes_wanted: arguments.minutes,
            rate_hz: arguments.rate_hz,
            swap_every_s: arguments.swap_every_s,
            drift_max_mib: arguments.drift_max_mib,
            drift_mib: None,
            drift_anonymous_mib: None,
            slope_mib_per_h: None,
            swaps_taken: 0,
            swaps_wrong: Vec::new(),
            phases: Vec::new(),
            samples: Vec::new(),
            run: serde_json::Value::Null,
            leftovers: Vec::new(),
        }
    }

    /// Sums up; `summary` is the run's own.
    pub(crate) fn finish(&mut self, summary: &[u8]) -> serde_json::Result<()> {
        self.run = serde_json::from_slice(summary)?;
        self.drift_mib = self.drift(|sample| sample.resident_kib);
        self.drift_anonymous_mib = self.drift(|sample| sample.anonymous_kib);
        self.slope_mib_per_h = self.slope();
        Ok(())
    }

    fn of_tenth(&self, tenth: usize, of: impl Fn(&Sample) -> u64) -> impl Iterator<Item = u64> {
        self.samples.iter().filter(move |sample| sample.tenth == tenth).map(of)
    }

    fn drift(&self, of: impl Fn(&Sample) -> u64 + Copy) -> Option<f64> {
        let last = median(self.of_tenth(TENTHS.len() - 1, of))?;
        Some((last - median(self.of_tenth(FIRST_COUNTED, of))?) / 1024.0)
    }

    fn slope(&self) -> Option<f64> {
        let counted = || self.samples.iter().filter(|sample| sample.tenth >= FIRST_COUNTED);
        let points = || counted().map(|sample| (sample.time_s / 3600.0, sample.resident_kib as f64 / 1024.0));
        let count = points().count() as f64;
        let mean = points().fold((0.0, 0.0), |sum, (x, y)| (sum.0 + x / count, sum.1 + y / count));
        let (sum_xy, sum_xx) = points().fold((0.0, 0.0), |(xy, xx), (x, y)| {
            (xy + (x - mean.0) * (y - mean.1), xx + (x - mean.0).powi(2))
        });
        (sum_xx > 0.0).then(|| sum_xy / sum_xx)
    }

    /// Whether all is as it should be.
    pub(crate) fn passes(&self) -> bool {
        let drift_fits = self.drift_mib.is_some_and(|drift_mib| drift_mib < self.drift_max_mib);
        drift_fits && self.swaps_wrong.is_empty() && self.leftovers.is_empty()
    }

    /// One line on the way.
    pub(crate) fn line(&self, elapsed: Duration) -> String {
        let now = self.samples.last().map_or(0.0, |sample| sample.resident_kib as f64 / 1024.0);
        let anonymous = self.samples.last().map_or(0.0, |sample| sample.anonymous_kib as f64 / 1024.0);
        let second = median(self.of_tenth(FIRST_COUNTED, |sample| sample.resident_kib));
        let second = second.map_or("-".to_owned(), |kib| format!("{:+.2}", now - kib / 1024.0));
        format!(
            "{:7.1} min  resident {now:.2} MiB (anonymous {anonymous:.2}), against the second tenth {second} MiB; swaps {}, wrong {}",
            elapsed.as_secs_f64() / 60.0,
            self.swaps_taken,
            self.swaps_wrong.len()
        )
    }

    /// The table for people.
    pub(crate) fn text(&self) -> String {
        let mut text = "  tenth  resident MiB (min, max)      anonymous  threads  files  observations  missed (published late)  \
                        p50 us  p99 us\n"
            .to_owned();
        for (tenth, name) in TENTHS.iter().enumerate() {
            text += &self.row(tenth, name);
        }
        let mib = |mib: Option<f64>| {
            mib.map_or("not known, it was ended early".into(), |mib| format!("{mib:+.3} MiB"))
        };
        text += &format!(
            "drift      {} resident, {} anonymous (last tenth against second, medians); slope {} an hour\n",
            mib(self.drift_mib),
            mib(self.drift_anonymous_mib),
            mib(self.slope_mib_per_h)
        );
        text += &format!("swaps      {} taken, {} wrong\n", self.swaps_taken, self.swaps_wrong.len());
        for line in &self.swaps_wrong {
            text += &format!("  wrong    {line}\n");
        }
        let counters = &self.run["counters"];
        let names = [
            "observations",
            "answers",
            "swaps",
            "missed_observations",
            "missed_deadlines",
            "missed_deadlines_published_late",
            "imagined_answers",
            "fallback_answers",
            "non_finite_outputs",
            "engine_errors",
            "helper_late",
        ];
        let counts = names.map(|name| format!("{} {}", name.replace('_', " "), counters[name]));
        text += &format!("run        {}\n", counts.join(", "));
        text + &format!("left       {:?} in shared memory\n", self.leftovers)
    }

    fn row(&self, tenth: usize, name: &str) -> String {
        let resident = || self.of_tenth(tenth, |sample| sample.resident_kib);
        let Some(middle) = median(resident()) else { return String::new() };
        let mib = |kib: u64| kib as f64 / 1024.0;
        let least_and_most = [resident().min(), resident().max()].map(|kib| mib(kib.unwrap_or(0)));
        let anonymous = median(self.of_tenth(tenth, |sample| sample.anonymous_kib)).unwrap_or(0.0) / 1024.0;
        let most = |of: fn(&Sample) -> u64| self.of_tenth(tenth, of).max().unwrap_or(0);
        let (threads, files) = (most(|sample| sample.threads), most(|sample| sample.open_files as u64));
        let empty = PhaseReport::default();
        let phase = self.phases.get(tenth).unwrap_or(&empty);
        let PhaseReport { observations, missed, missed_published_late, latency_us, .. } = phase;
        format!(
            "  {name:>5}  {:>9.2} ({:.2}, {:.2})  {anonymous:>13.2}  {threads:>7}  {files:>5}  {observations:>12}  {missed:>6} \
             ({missed_published_late})  {:>20.0}  {:>6.0}\n",
            middle / 1024.0,
            least_and_most[0],
            least_and_most[1],
            latency_us.p50,
            latency_us.p99
        )
    }
}
