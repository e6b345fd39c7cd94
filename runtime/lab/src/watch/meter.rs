//! What an observer of the link can tell, counted and timed.
//!
//! It sees the newest message only: what comes while it draws is lost to it, and counted as unseen by the gaps in the sequence.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rcwm_models::wire::{Action, ActionSource, Format, Observation, ObservationFlags, ObservationHeader};
use serde::Serialize;

use crate::log::mode;

/// Latencies that are remembered, and observations that may still be answered.
const LATENCIES_MAX: usize = 1024;
const UNANSWERED_MAX: usize = 64;
/// The rate is that of so long.
const RATE_WINDOW_NS: u64 = 2_000_000_000;
/// A controller that was silent for so long, and for so many periods, is not there.
const SILENCE: Duration = Duration::from_secs(1);
const SILENT_PERIODS: u64 = 5;

/// An observation whose answer was not seen yet.
struct Unanswered {
    sequence: u64,
    published_ns: u64,
}

/// Counts and times what it is shown.
#[derive(Default)]
pub struct Meter {
    format: Option<Arc<Format>>,
    last: Option<ObservationHeader>,
    state: Vec<f32>,
    /// Lowest and highest number of each state so far.
    state_ranges: Vec<(f32, f32)>,
    executed: Vec<f32>,
    sent: Option<(Action, Instant)>,
    unanswered: VecDeque<Unanswered>,
    latencies_ns: VecDeque<u64>,
    /// When which sequence was published.
    published: VecDeque<(u64, u64)>,
    counts: Counts,
}

/// Counts since the watcher began.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counts {
    /// Observations, without those that were published again.
    pub observations: u64,
    /// Observations that came and went unseen.
    pub unseen: u64,
    /// Those that say that no answer had come in time for them.
    pub deadlines_missed: u64,
    /// Answers.
    pub answers: u64,
    /// Those on a state that the world model imagined.
    pub imagined: u64,
    /// Those by the fallback.
    pub fallback: u64,
}

/// Times of the last [`LATENCIES_MAX`] answers, in us.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Percentiles {
    pub p50: f64,
    pub p99: f64,
    pub max: f64,
}

/// What is known now; a line of `--json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Snapshot {
    pub instance: String,
    /// The robot's name; none while none is there.
    pub robot: Option<String>,
    /// Observations a second.
    pub rate_hz: Option<f64>,
    /// The control period; none in lock-step.
    pub period_us: Option<f64>,
    /// See `docs/controller.md`; none while no controller answers.
    pub mode: Option<&'static str>,
    /// From an observation's publishing to that of its answer.
    pub latency_us: Option<Percentiles>,
    #[serde(flatten)]
    pub counts: Counts,
    pub episode: Option<u64>,
    pub step: Option<u32>,
    pub reward: Option<f32>,
    pub flags: Vec<&'static str>,
}

impl Meter {
    /// A robot is there.
    pub fn robot_came(&mut self, format: &Arc<Format>) {
        if self.format.as_ref() != Some(format) {
            self.state_ranges.clear();
        }
        self.format = Some(Arc::clone(format));
        self.forget();
    }

    /// It is gone.
    pub fn robot_left(&mut self) {
        self.format = None;
        self.forget();
    }

    /// What comes is of another count of sequences.
    fn forget(&mut self) {
        self.unanswered.clear();
        self.published.clear();
        self.sent = None;
    }

    pub fn observed(&mut self, observation: &Observation<'_>) {
        let header: ObservationHeader = **observation;
        if header.is(ObservationFlags::REPEATED) {
            return;
        }
        match self.last {
            Some(last) if header.sequence <= last.sequence => self.forget(),
            Some(last) if !self.published.is_empty() => {
                self.counts.unseen += header.sequence - last.sequence - 1;
            }
            _ => {}
        }
        self.counts.observations += 1;
        self.counts.deadlines_missed += u64::from(header.is(ObservationFlags::ACTION_HELD));
        let ObservationHeader { sequence, published_ns, .. } = header;
        push(&mut self.unanswered, Unanswered { sequence, published_ns }, UNANSWERED_MAX);
        self.published.push_back((published_ns, sequence));
        let begin_ns = published_ns.saturating_sub(RATE_WINDOW_NS);
        while self.published.front().is_some_and(|(at_ns, _)| *at_ns < begin_ns) {
            self.published.pop_front();
        }
        self.last = Some(header);
        self.state.clear();
        self.state.extend_from_slice(observation.state());
        self.executed.clear();
        self.executed.extend_from_slice(observation.executed());
        self.state_ranges.resize(self.state.len(), (f32::INFINITY, f32::NEG_INFINITY));
        for ((low, high), value) in self.state_ranges.iter_mut().zip(&self.state) {
            (*low, *high) = (low.min(*value), high.max(*value));
        }
    }

    pub fn answered(&mut self, action: Action) {
        self.counts.answers += 1;
        match ActionSource::from_wire(action.source) {
            Some(ActionSource::Imagined) => self.counts.imagined += 1,
            Some(ActionSource::Fallback) => self.counts.fallback += 1,
            Some(ActionSource::Policy) | None => {}
        }
        while let Some(observation) = self.unanswered.front().filter(|it| it.sequence <= action.answers) {
            if observation.sequence == action.answers {
                let latency_ns = action.published_ns.saturating_sub(observation.published_ns);
                push(&mut self.latencies_ns, latency_ns, LATENCIES_MAX);
            }
            self.unanswered.pop_front();
        }
        self.sent = Some((action, Instant::now()));
    }

    pub fn format(&self) -> Option<&Arc<Format>> {
        self.format.as_ref()
    }

    /// The numbers that were measured last, each with its lowest and highest so far.
    pub fn state(&self) -> impl Iterator<Item = (f32, (f32, f32))> {
        self.state.iter().copied().zip(self.state_ranges.iter().copied())
    }

    /// The action that was executed last.
    pub fn executed(&self) -> &[f32] {
        &self.executed
    }

    /// The action that was sent last, while a controller is there.
    pub fn sent(&self) -> Option<&Action> {
        let period_ns = self.last.map_or(0, |last| last.period_ns);
        let silence = SILENCE.max(Duration::from_nanos(period_ns.saturating_mul(SILENT_PERIODS)));
        self.sent.as_ref().filter(|(_, heard)| heard.elapsed() < silence).map(|(action, _)| action)
    }

    /// The last latencies, the newest last, in us.
    pub fn latencies_us(&self) -> impl DoubleEndedIterator<Item = f64> {
        self.latencies_ns.iter().map(|ns| *ns as f64 / 1e3)
    }

    pub fn snapshot(&self, instance: &str) -> Snapshot {
        let last = self.last.filter(|_| self.format.is_some());
        let period_ns = last.map(|last| last.period_ns).filter(|period_ns| *period_ns > 0);
        Snapshot {
            instance: instance.to_owned(),
            robot: self.format.as_ref().map(|format| format.interface().name.clone()),
            rate_hz: self.rate_hz(),
            period_us: period_ns.map(|period_ns| period_ns as f64 / 1e3),
            mode: self.sent().map(|action| mode(action.source)),
            latency_us: self.percentiles(),
            counts: self.counts,
            episode: last.map(|last| last.episode),
            step: last.map(|last| last.step),
            // JSON has no other numbers.
            reward: last.map(|last| last.reward).filter(|reward| reward.is_finite()),
            flags: last.map_or_else(Vec::new, |last| ObservationFlags(last.flags).names().collect()),
        }
    }

    fn rate_hz(&self) -> Option<f64> {
        let ((from_ns, first), (to_ns, last)) = (self.published.front()?, self.published.back()?);
        (to_ns > from_ns).then(|| (last - first) as f64 * 1e9 / (to_ns - from_ns) as f64)
    }

    fn percentiles(&self) -> Option<Percentiles> {
        let mut sorted: Vec<_> = self.latencies_us().collect();
        sorted.sort_by(f64::total_cmp);
        let at = |share: f64| sorted.get((share * (sorted.len() - 1) as f64).round() as usize).copied();
        let max = *sorted.last()?;
        Some(Percentiles { p50: at(0.5)?, p99: at(0.99)?, max })
    }
}

/// At most `max` are remembered.
fn push<T>(to: &mut VecDeque<T>, value: T, max: usize) {
    if to.len() == max {
        to.pop_front();
    }
    to.push_back(value);
}
