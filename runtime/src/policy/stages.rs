//! The time that each stage of a tick takes.

use std::time::Instant;

use rcwm_models::bundle::PartName;

use super::STAGES;

/// Adds up the time between one look and the next, per stage.
pub(super) struct StageClock {
    last: Instant,
    /// Time spent in each of [`STAGES`], in ns.
    pub(super) spent_ns: [u64; STAGES.len()],
    /// The second thread was not waited for.
    pub(super) helper_late: bool,
}

impl StageClock {
    pub(super) fn start() -> Self {
        Self { last: Instant::now(), spent_ns: [0; STAGES.len()], helper_late: false }
    }

    /// The stage has ended now.
    pub(super) fn ended(&mut self, stage: PartName) {
        let now = Instant::now();
        self.took(stage, now.duration_since(self.last).as_nanos() as u64);
        self.last = now;
    }

    /// The stage took this long, beside another.
    pub(super) fn took(&mut self, stage: PartName, time_ns: u64) {
        if let Some(index) = STAGES.iter().position(|name| *name == stage) {
            self.spent_ns[index] += time_ns;
        }
    }

    /// The next stage begins now.
    pub(super) fn restart(&mut self) {
        self.last = Instant::now();
    }
}
