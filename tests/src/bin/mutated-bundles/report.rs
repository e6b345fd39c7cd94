//! What a run is summed up to.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::Arguments;
use crate::child::Ended;

/// Something that must not happen.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Finding {
    /// Makes the case again.
    pub(crate) seed: u64,
    /// `died`, `hung`, `slow`, `memory` or `invalid action`.
    pub(crate) kind: &'static str,
    /// What is known about it.
    pub(crate) text: String,
}

/// The whole run.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    seed: u64,
    count: u64,
    memory_limit_mib: u64,
    cpu_limit_s: f64,
    /// Seed to go on from.
    next_seed: u64,
    cases: u64,
    /// How far the cases came, by the step that refused them.
    ended: BTreeMap<String, u64>,
    /// Panics inside an engine that the runtime turned into an error.
    caught_panics: u64,
    /// The first seeds that had one.
    caught_panic_seeds: Vec<u64>,
    cpu_s_max: f64,
    wall_s_max: f64,
    resident_mib_max: f64,
    /// What must not happen.
    pub(crate) findings: Vec<Finding>,
}

impl Report {
    pub(crate) fn new(arguments: &Arguments) -> Self {
        Self {
            seed: arguments.seed,
            count: arguments.count,
            memory_limit_mib: arguments.memory_mib,
            cpu_limit_s: arguments.cpu_s_max,
            next_seed: arguments.seed,
            cases: 0,
            ended: BTreeMap::new(),
            caught_panics: 0,
            caught_panic_seeds: Vec::new(),
            cpu_s_max: 0.0,
            wall_s_max: 0.0,
            resident_mib_max: 0.0,
            findings: Vec::new(),
        }
    }

    /// The next case, unless all are handed out.
    pub(crate) fn next_seed(&mut self) -> Option<u64> {
        let seed = self.next_seed;
        (seed - self.seed < self.count).then(|| {
            self.next_seed += 1;
            seed
        })
    }

    /// Notes how a case ended; a line to be printed at once where it is a finding.
    pub(crate) fn note(&mut self, seed: u64, ended: &Ended) -> Option<String> {
        self.cases += 1;
        let (kind, text) = match ended {
            Ended::Died(words) => ("died", words.clone()),
            Ended::Hung => ("hung", String::new()),
            Ended::Answered(outcome) => {
                *self.ended.entry(outcome.ended.clone()).or_default() += 1;
                self.caught_panics += outcome.caught_panics;
                if outcome.caught_panics > 0 && self.caught_panic_seeds.len() < 20 {
                    self.caught_panic_seeds.push(seed);
                }
                self.cpu_s_max = self.cpu_s_max.max(outcome.cpu_s);
                self.wall_s_max = self.wall_s_max.max(outcome.wall_s);
                self.resident_mib_max = self.resident_mib_max.max(outcome.resident_mib_max);
                let kind = if outcome.ended == "invalid action" {
                    "invalid action"
                } else if outcome.cpu_s > self.cpu_limit_s {
                    "slow"
                } else if outcome.resident_mib_max > self.memory_limit_mib as f64 {
                    "memory"
                } else {
                    return None;
                };
                (kind, format!("{outcome:?}"))
            }
        };
        self.findings.push(Finding { seed, kind, text: text.clone() });
        Some(format!("finding: seed {seed} {kind} {text}"))
    }

    /// The summary for people.
    pub(crate) fn text(&self) -> String {
        let steps: Vec<_> = self.ended.iter().map(|(step, count)| format!("{step} {count}")).collect();
        let mut text = format!(
            "cases      {} of {} from seed {}; ended at: {}\n",
            self.cases,
            self.count,
            self.seed,
            steps.join(", ")
        );
        text += &format!(
            "worst      {:.3} s of processor, {:.3} s in all, {:.1} MiB resident (limit {} MiB of writable memory)\n",
            self.cpu_s_max, self.wall_s_max, self.resident_mib_max, self.memory_limit_mib
        );
        text += &format!(
            "panics     {} caught inside the engine {:?}\n",
            self.caught_panics, self.caught_panic_seeds
        );
        text += &format!("findings   {}\n", self.findings.len());
        if self.cases < self.count {
            text += &format!("goes on with --seed {}\n", self.next_seed);
        }
        text
    }
}
