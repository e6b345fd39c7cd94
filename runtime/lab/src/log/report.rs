//! What a replay is summed up to.

use rcwm_models::wire::ActionSource;
use serde::Serialize;

use rcwm_runtime::EngineSettings;
use rcwm_runtime::log::Header;
use rcwm_runtime::telemetry::{Latency, table};

/// Ticks by the source of what was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Answers {
    /// The policy, on an observation.
    pub policy: u64,
    /// The policy, on a state that the world model imagined.
    pub imagined: u64,
    pub fallback: u64,
}

impl Answers {
    pub(super) fn count(&mut self, source: u32) {
        match ActionSource::from_wire(source) {
            Some(ActionSource::Policy) => self.policy += 1,
            Some(ActionSource::Imagined) => self.imagined += 1,
            Some(ActionSource::Fallback) => self.fallback += 1,
            None => {}
        }
    }
}

/// Where a replay differs from the log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The tick, counted from 0 in the log.
    pub tick: u64,
    /// Sequence of the observation that was answered.
    pub sequence: u64,
    /// What differs.
    pub what: String,
    /// What the log holds.
    pub logged: String,
    /// What the replay gave.
    pub replayed: String,
}

/// A replay, as printed and as written with `--json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReplayReport {
    /// The engine it was replayed on.
    pub engine: EngineSettings,
    /// What the run was made with.
    pub log: Header,
    /// The log has its proper end.
    pub log_finished: bool,
    /// Where the log is damaged; all before it was replayed.
    pub log_damage: Option<String>,
    /// Ticks replayed.
    pub ticks: u64,
    /// Ticks whose calls are in the log and were made again; the others follow on dropped ones.
    pub ticks_compared: u64,
    /// Ticks that the log says were dropped.
    pub ticks_dropped: u64,
    /// What was sent, by source.
    pub answers: Answers,
    /// Calls made again.
    pub calls: u64,
    /// Work ahead that was done again because another action was executed.
    pub recomputed: u64,
    /// Calls on which the policy failed, as logged.
    pub failures: u64,
    /// Policies that took over while it ran.
    pub swaps: u64,
    /// Ticks that differ in anything.
    pub ticks_differing: u64,
    /// Largest difference of an action's component.
    pub action_error_max: f32,
    /// The first difference; none when all is the same bit for bit.
    pub first_difference: Option<Difference>,
    /// Times of the replay.
    pub latency: Vec<Latency>,
}

impl ReplayReport {
    pub(super) fn new(log: Header, engine: EngineSettings) -> Self {
        Self {
            engine,
            log,
            log_finished: false,
            log_damage: None,
            ticks: 0,
            ticks_compared: 0,
            ticks_dropped: 0,
            answers: Answers::default(),
            calls: 0,
            recomputed: 0,
            failures: 0,
            swaps: 0,
            ticks_differing: 0,
            action_error_max: 0.0,
            first_difference: None,
            latency: Vec::new(),
        }
    }

    /// The report for people.
    #[must_use]
    pub fn text(&self) -> String {
        let Self {
            ticks, ticks_compared, ticks_dropped, answers, calls, recomputed, failures, swaps, ..
        } = self;
        let Answers { policy, imagined, fallback } = answers;
        let mut text = format!(
            "replay     {} bundle for {}, engine {}, logged on {} {}\n",
            self.log.bundle.preset,
            self.log.bundle.task,
            self.engine.kind,
            self.log.machine.architecture,
            self.log.machine.processor
        );
        text += &format!(
            "ticks      {ticks}, compared {ticks_compared}, dropped in the log {ticks_dropped}; answers: policy {policy}, imagined \
             {imagined}, fallback {fallback}\n"
        );
        text += &format!(
            "calls      {calls}, recomputed {recomputed}, failed as logged {failures}, swaps {swaps}\n"
        );
        if !self.log_finished && self.log_damage.is_none() {
            text += "log        has no end: it was cut, or is still being written\n";
        }
        text += &match self.ticks_differing {
            0 => format!("result     all {ticks_compared} ticks are the same, bit for bit\n"),
            count => format!(
                "result     {count} of {ticks_compared} ticks differ; largest difference of an action {:.3e}\n",
                self.action_error_max
            ),
        };
        text + &table(&self.latency)
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { tick, sequence, what, logged, replayed } = self;
        write!(f, "tick {tick} (observation {sequence}): {what}: logged {logged}, replayed {replayed}")
    }
}
