//! What a campaign is summed up to.

use std::collections::BTreeMap;

use rcwm_runtime::controller::Ended;
use serde::Serialize;

use crate::Arguments;
use crate::run::Outcome;
use crate::scenario::Scenario;

/// Something that must not happen.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Finding {
    /// The run.
    pub(crate) seed: u64,
    /// Messages by then.
    pub(crate) message: u64,
    /// Which invariant.
    pub(crate) kind: &'static str,
    /// What is known about it.
    pub(crate) text: String,
    /// How the controller was set up.
    pub(crate) setup: String,
    /// Deeds of the peer that are left.
    pub(crate) kept: usize,
    /// Shows it again.
    pub(crate) command: String,
}

impl Finding {
    /// For people: in full the first of its kind.
    pub(crate) fn lines(&self, in_full: bool) -> String {
        let Self { seed, message, kind, text, kept, command, .. } = self;
        if !in_full {
            return format!("finding: seed {seed}, message {message}: {kind}\n");
        }
        format!(
            "finding: seed {seed}, message {message}: {kind}: {text}\n  again with {kept} of its deeds: {command}\n"
        )
    }
}

/// The whole campaign.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    seed: u64,
    /// Messages that were asked for.
    messages_min: u64,
    /// Seed to go on from.
    next_seed: u64,
    findings_max: usize,
    runs: u64,
    messages: u64,
    messages_in_lockstep: u64,
    messages_in_real_time: u64,
    actions: u64,
    /// Of the policy, imagined, fallback.
    by_source: [u64; 3],
    repeated: u64,
    swaps: u64,
    /// How the runs ended.
    ended: BTreeMap<String, u64>,
    /// Findings by kind, those that were not shortened included.
    kinds: BTreeMap<&'static str, u64>,
    /// What must not happen.
    pub(crate) findings: Vec<Finding>,
}

impl Report {
    pub(crate) fn new(arguments: &Arguments) -> Self {
        Self {
            seed: arguments.seed,
            messages_min: arguments.messages,
            next_seed: arguments.seed,
            findings_max: arguments.findings_max,
            runs: 0,
            messages: 0,
            messages_in_lockstep: 0,
            messages_in_real_time: 0,
            actions: 0,
            by_source: [0; 3],
            repeated: 0,
            swaps: 0,
            ended: BTreeMap::new(),
            kinds: BTreeMap::new(),
            findings: Vec::new(),
        }
    }

    /// The next run, unless there were enough messages or findings.
    pub(crate) fn next_seed(&mut self) -> Option<u64> {
        let seed = self.next_seed;
        (self.messages < self.messages_min && self.findings.len() < self.findings_max).then(|| {
            self.next_seed += 1;
            seed
        })
    }

    /// Notes how a run ended; whether it has a finding of a new kind.
    pub(crate) fn note(&mut self, scenario: &Scenario, outcome: &Outcome) -> bool {
        self.runs += 1;
        self.messages += outcome.messages;
        match scenario.setup.period_ns {
            0 => self.messages_in_lockstep += outcome.messages,
            _ => self.messages_in_real_time += outcome.messages,
        }
        self.actions += outcome.sent.all;
        for (sum, count) in self.by_source.iter_mut().zip(outcome.sent.by_source) {
            *sum += count;
        }
        self.repeated += outcome.sent.repeated;
        self.swaps += outcome.swaps;
        let name =
            |ended: Ended| serde_json::to_value(ended).ok().and_then(|name| Some(name.as_str()?.to_owned()));
        let ended = outcome.ended.and_then(name).unwrap_or_else(|| "panic".into());
        *self.ended.entry(ended).or_default() += 1;
        let Some((violation, ..)) = &outcome.violation else { return false };
        let count = self.kinds.entry(violation.kind).or_default();
        *count += 1;
        *count == 1
    }

    /// The summary for people.
    pub(crate) fn text(&self) -> String {
        let Self { runs, messages, seed, next_seed, actions, repeated, swaps, .. } = self;
        let [policy, imagined, fallback] = self.by_source;
        let ended: Vec<_> = self.ended.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let kinds: Vec<_> = self.kinds.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let mut text = format!(
            "messages   {messages} in {runs} runs from seed {seed}: {} in lock-step, {} in real time\n",
            self.messages_in_lockstep, self.messages_in_real_time
        );
        text += &format!(
            "actions    {actions}: of the policy {policy}, imagined {imagined}, fallback {fallback}; {repeated} of them sent again\n"
        );
        text += &format!("swaps      {swaps}\nended      {}\n", ended.join(", "));
        text += &format!("findings   {} {}\n", self.findings.len(), kinds.join(", "));
        if *messages < self.messages_min {
            text += &format!("goes on with --seed {next_seed}\n");
        }
        text
    }
}
