//! What a run counted, for people and as JSON.

use std::fmt;

use hdrhistogram::Histogram;
use serde::Serialize;

/// Times beyond this are recorded as this.
const TIME_US_MAX: u64 = 3_600_000_000;

/// Distribution of durations in microseconds.
#[derive(Debug, Clone)]
pub struct Durations(Histogram<u64>);

/// Percentiles of [`Durations`], in microseconds.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Percentiles {
    pub count: u64,
    pub p50_us: u64,
    pub p99_us: u64,
    pub p999_us: u64,
    pub max_us: u64,
}

impl Default for Durations {
    fn default() -> Self {
        Self(Histogram::new_with_bounds(1, TIME_US_MAX, 3).expect("the bounds are valid"))
    }
}

impl Durations {
    /// Adds one duration.
    pub fn add_ns(&mut self, ns: u64) {
        self.0.saturating_record(ns / 1_000);
    }

    /// Percentiles so far.
    #[must_use]
    pub fn percentiles(&self) -> Percentiles {
        let at = |share| self.0.value_at_quantile(share);
        Percentiles {
            count: self.0.len(),
            p50_us: at(0.5),
            p99_us: at(0.99),
            p999_us: at(0.999),
            max_us: self.0.max(),
        }
    }
}

impl fmt::Display for Percentiles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |us: u64| us as f64 / 1e3;
        write!(
            f,
            "p50 {:.3} ms, p99 {:.3} ms, p99.9 {:.3} ms, max {:.3} ms",
            ms(self.p50_us),
            ms(self.p99_us),
            ms(self.p999_us),
            ms(self.max_us)
        )
    }
}

/// Everything that is counted while serving.
#[derive(Debug, Default)]
pub struct Tally {
    /// Return and success of each whole episode.
    pub episodes: Vec<(f64, bool)>,
    /// Actions executed, those of an unfinished episode included.
    pub steps: u64,
    /// Observations published, repeated ones not included.
    pub observations: u64,
    /// Observations published again for a new or silent controller.
    pub repeated: u64,
    /// Steps for which no valid answer had come.
    pub held: u64,
    /// Those of them at which the robot rested, because the controller had left or been silent for long (real time).
    pub rested: u64,
    /// Actions that answered another observation than the present one.
    pub dropped: u64,
    /// Actions with a value that is not finite.
    pub refused: u64,
    /// Ticks of the fixed clock that were lost because the one before took too long.
    pub missed: u64,
    /// Controllers that have announced themselves.
    pub controllers_came: u64,
    /// Controllers that have said that they leave; one that was killed does not.
    pub controllers_left: u64,
    /// From publishing an observation to its answer, the very first one excepted.
    pub answer: Durations,
    /// Physics and pictures of one step.
    pub work: Durations,
    /// Time of the serving loop since the first answer.
    pub seconds: f64,
}

/// The result of a run, as written to `--json`.
#[derive(Debug, Serialize)]
pub struct Report {
    pub task: String,
    pub instance: String,
    pub seed: u64,
    pub first_episode: u64,
    pub episodes: usize,
    pub successes: usize,
    pub success_rate: Option<f64>,
    pub return_mean: Option<f64>,
    pub returns: Vec<f64>,
    pub successful: Vec<bool>,
    pub steps: u64,
    pub observations: u64,
    pub observations_repeated: u64,
    pub seconds: f64,
    pub steps_per_s: f64,
    pub actions_held: u64,
    pub steps_at_rest: u64,
    pub actions_dropped: u64,
    pub actions_refused: u64,
    pub ticks_missed: u64,
    pub controllers_came: u64,
    pub controllers_left: u64,
    pub answer: Percentiles,
    pub work: Percentiles,
}

impl Tally {
    /// Sums up.
    #[must_use]
    pub fn report(self, task: &str, instance: &str, seed: u64, first_episode: u64) -> Report {
        let episodes = self.episodes.len();
        let successes = self.episodes.iter().filter(|(_, success)| *success).count();
        let share = |x: f64| (episodes > 0).then(|| x / episodes as f64);
        Report {
            task: task.to_owned(),
            instance: instance.to_owned(),
            seed,
            first_episode,
            episodes,
            successes,
            success_rate: share(successes as f64),
            return_mean: share(self.episodes.iter().map(|(sum, _)| sum).sum()),
            returns: self.episodes.iter().map(|(sum, _)| *sum).collect(),
            successful: self.episodes.iter().map(|(_, success)| *success).collect(),
            steps: self.steps,
            observations: self.observations,
            observations_repeated: self.repeated,
            seconds: self.seconds,
            steps_per_s: if self.seconds > 0.0 { self.steps as f64 / self.seconds } else { 0.0 },
            actions_held: self.held,
            steps_at_rest: self.rested,
            actions_dropped: self.dropped,
            actions_refused: self.refused,
            ticks_missed: self.missed,
            controllers_came: self.controllers_came,
            controllers_left: self.controllers_left,
            answer: self.answer.percentiles(),
            work: self.work.percentiles(),
        }
    }
}

impl Report {
    /// What is to be said of a clock that was not kept.
    #[must_use]
    pub fn remark(&self, period_ns: u64) -> Option<String> {
        // One tick in twenty: less is a hiccup.
        let slow = self.ticks_missed * 20 > self.observations + self.ticks_missed;
        let ms = |ns: f64| ns / 1e6;
        slow.then(|| {
            format!(
                "this machine cannot keep {:.1} Hz: {} ticks were skipped; a step takes {:.1} ms (p50) of the {:.1} ms there are; \
                 lower --rate-hz",
                1e9 / period_ns as f64,
                self.ticks_missed,
                ms(1e3 * self.work.p50_us as f64),
                ms(period_ns as f64)
            )
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} (seed {}, instance {:?})", self.task, self.seed, self.instance)?;
        write!(f, "  episodes     {}", self.episodes)?;
        if let (Some(rate), Some(mean)) = (self.success_rate, self.return_mean) {
            write!(f, ", success {:.0}% ({}), mean return {mean:.1}", rate * 100.0, self.successes)?;
        }
        writeln!(
            f,
            "\n  steps        {} in {:.1} s: {:.1} a second",
            self.steps, self.seconds, self.steps_per_s
        )?;
        writeln!(
            f,
            "  actions      {} held ({} of them at rest), {} dropped (late or doubled), {} refused (not finite)",
            self.actions_held, self.steps_at_rest, self.actions_dropped, self.actions_refused
        )?;
        if self.ticks_missed > 0 {
            writeln!(f, "  clock        {} ticks missed", self.ticks_missed)?;
        }
        writeln!(
            f,
            "  controllers  {} came, {} said goodbye; {} observations repeated",
            self.controllers_came, self.controllers_left, self.observations_repeated
        )?;
        if self.answer.count > 0 {
            writeln!(f, "  answer       {}", self.answer)?;
        }
        write!(f, "  work         {}", self.work)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_without_a_whole_episode_has_no_rates() {
        let report = Tally { steps: 3, ..Tally::default() }.report("reach", "a", 0, 0);
        assert!(report.success_rate.is_none() && report.return_mean.is_none());
        assert!(serde_json::to_string(&report).unwrap().contains("\"success_rate\":null"));
        assert!(report.to_string().contains("episodes     0\n"));
    }

    #[test]
    fn a_clock_that_is_not_kept_is_remarked_with_the_remedy() {
        let report =
            |missed| Tally { observations: 100, missed, ..Tally::default() }.report("reach", "a", 0, 0);
        assert!(report(3).remark(2_000_000).is_none());
        let remark = report(50).remark(2_000_000).unwrap();
        assert!(remark.contains("cannot keep 500.0 Hz") && remark.contains("--rate-hz"), "{remark}");
    }

    #[test]
    fn success_and_return_are_averaged_over_whole_episodes() {
        let tally = Tally { episodes: vec![(10.0, true), (30.0, false)], ..Tally::default() };
        let report = tally.report("reach", "a", 0, 0);
        assert_eq!((report.success_rate, report.return_mean), (Some(0.5), Some(20.0)));
    }
}
