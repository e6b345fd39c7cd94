//! What does not fit between robot and policy, and is nobody's error: another rate, another task, a clock that is not kept.

use rcwm_models::bundle::Manifest;
use rcwm_models::tasks::{OWN_TASK, task_name};
use rcwm_models::wire::ObservationHeader;

use crate::controller::Counters;
use crate::record::Record;

/// Rates that differ by less are the same.
const RATE_TOLERANCE: f64 = 0.01;
/// A clock that is slower by more than this is not kept.
const SLOWER: f64 = 1.1;
/// Observations of one episode from which the pace of a clock is told.
const PACE_OBSERVATIONS: u64 = 20;
/// One observation in so many may come late: that is a hiccup.
const LATE_SHARE: u64 = 10;

/// Looks at every observation; each remark is made once a policy.
#[derive(Debug, Default)]
pub(super) struct Remarks {
    made: Vec<String>,
    told: usize,
    task: Option<u32>,
    period_ns: u64,
    slow_told: bool,
    first: Option<Paced>,
}

/// An observation's place in its episode and in time.
#[derive(Debug, Clone, Copy)]
struct Paced {
    episode: u64,
    sequence: u64,
    scheduled_ns: u64,
}

impl Remarks {
    /// What is new with this tick of a policy of this manifest.
    pub(super) fn of(&mut self, record: &Record, manifest: &Manifest) -> &[String] {
        if record.exchanged.is_some() {
            (self.task, self.period_ns) = (None, 0);
        }
        if record.observed {
            self.look(&record.observation, &manifest.task, manifest.interface.rate_hz);
        }
        self.lateness(&record.counters);
        let new = self.told;
        self.told = self.made.len();
        &self.made[new..]
    }

    /// All that was remarked.
    pub(super) fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.made)
    }

    fn look(&mut self, observation: &ObservationHeader, task: &str, rate_hz: f64) {
        if self.task != Some(observation.task) {
            self.task = Some(observation.task);
            let found = task_name(observation.task);
            let own = task_name(OWN_TASK);
            if found != task && found != own && task != own {
                self.remark(format!("the task is {found}, but the policy was trained for {task}"));
            }
        }
        if observation.period_ns != self.period_ns {
            (self.period_ns, self.slow_told, self.first) = (observation.period_ns, false, None);
            let found_hz = 1e9 / observation.period_ns.max(1) as f64;
            if observation.period_ns > 0 && (found_hz / rate_hz - 1.0).abs() > RATE_TOLERANCE {
                self.remark(format!(
                    "the robot's rate is {found_hz:.1} Hz, but the policy was trained for {rate_hz:.1} Hz: what it expects of an \
                     action comes at another time"
                ));
            }
        }
        self.pace(observation);
    }

    /// Whether ticks of the robot's clock are skipped.
    fn pace(&mut self, observation: &ObservationHeader) {
        let &ObservationHeader { episode, sequence, scheduled_ns, period_ns, .. } = observation;
        if period_ns == 0 || self.slow_told {
            return;
        }
        let now = Paced { episode, sequence, scheduled_ns };
        let Some(first) = self.first.filter(|first| first.episode == episode) else {
            self.first = Some(now);
            return;
        };
        let steps = sequence.saturating_sub(first.sequence);
        if steps < PACE_OBSERVATIONS {
            return;
        }
        let found_ns = scheduled_ns.saturating_sub(first.scheduled_ns) as f64 / steps as f64;
        if found_ns > SLOWER * period_ns as f64 {
            self.slow_told = true;
            self.remark(format!(
                "the robot or simulator cannot keep its rate: it says {:.1} Hz and skips so many ticks that {:.1} Hz are left; lower \
                 its rate (rcwm-simulator serve --rate-hz)",
                1e9 / period_ns as f64,
                1e9 / found_ns
            ));
        }
        self.first = Some(now);
    }

    /// Whether observations come so late that they are dropped, or published long after they were due. Such ones may be all there are.
    fn lateness(&mut self, counters: &Counters) {
        let Counters { observations, stale_observations, published_late, .. } = *counters;
        let late = stale_observations.saturating_add(published_late);
        if self.period_ns == 0 || self.slow_told || observations < PACE_OBSERVATIONS {
            return;
        }
        if late > observations / LATE_SHARE {
            self.slow_told = true;
            self.remark(format!(
                "{late} of the first {observations} observations came long after they were due: the robot or simulator cannot keep \
                 its rate of {:.1} Hz; lower it (rcwm-simulator serve --rate-hz)",
                1e9 / self.period_ns as f64
            ));
        }
    }

    /// The same is not said twice, as it would be of a robot that comes and goes.
    fn remark(&mut self, remark: String) {
        if !self.made.contains(&remark) {
            self.made.push(remark);
        }
    }
}

#[cfg(test)]
mod tests {
    use rcwm_models::tasks::task_id;

    use super::*;

    fn observation(sequence: u64, scheduled_ns: u64) -> ObservationHeader {
        ObservationHeader {
            sequence,
            scheduled_ns,
            period_ns: 25_000_000,
            task: task_id("reach").unwrap(),
            ..ObservationHeader::zeroed()
        }
    }

    #[test]
    fn what_fits_is_not_remarked() {
        let mut remarks = Remarks::default();
        for tick in 0..100 {
            remarks.look(&observation(tick, tick * 25_000_000), "reach", 40.0);
        }
        let lockstep = ObservationHeader { period_ns: 0, ..observation(0, 0) };
        remarks.look(&lockstep, "reach", 40.0);
        remarks.look(&ObservationHeader { task: OWN_TASK, ..lockstep }, "hammer", 40.0);
        remarks.look(&lockstep, "own", 40.0);
        assert_eq!(remarks.take(), Vec::<String>::new());
    }

    #[test]
    fn another_task_and_another_rate_are_remarked_once() {
        let mut remarks = Remarks::default();
        for tick in 0..100 {
            remarks.look(&observation(tick, tick * 25_000_000), "hammer", 20.0);
        }
        let made = remarks.take();
        assert_eq!(made.len(), 2, "{made:?}");
        assert!(made[0].contains("task is reach") && made[0].contains("trained for hammer"), "{made:?}");
        assert!(made[1].contains("40.0 Hz") && made[1].contains("20.0 Hz"), "{made:?}");
    }

    #[test]
    fn observations_that_come_long_after_they_were_due_are_remarked() {
        let counters =
            |stale_observations| Counters { observations: 100, stale_observations, ..Counters::default() };
        let mut remarks = Remarks::default();
        remarks.lateness(&counters(90));
        assert_eq!(remarks.take(), Vec::<String>::new(), "lock-step has no clock");
        remarks.look(&observation(0, 0), "reach", 40.0);
        remarks.lateness(&counters(9));
        assert_eq!(remarks.take(), Vec::<String>::new());
        remarks.lateness(&counters(90));
        remarks.lateness(&counters(95));
        let made = remarks.take();
        assert!(made.len() == 1 && made[0].contains("90 of the first 100"), "{made:?}");
        assert!(made[0].contains("cannot keep"), "{made:?}");
    }

    #[test]
    fn a_clock_that_skips_every_third_tick_is_remarked_and_a_pause_between_episodes_is_not() {
        let mut remarks = Remarks::default();
        for tick in 0..60 {
            let pause = if tick < 30 { 0 } else { 10_000_000_000 };
            let episode = tick / 30;
            remarks.look(
                &ObservationHeader { episode, ..observation(tick, tick * 25_000_000 + pause) },
                "reach",
                40.0,
            );
        }
        assert_eq!(remarks.take(), Vec::<String>::new());
        for tick in 0..60 {
            remarks.look(&observation(tick, (tick + tick / 2) * 25_000_000), "reach", 40.0);
        }
        let made = remarks.take();
        assert!(made.len() == 1 && made[0].contains("cannot keep its rate"), "{made:?}");
    }
}
