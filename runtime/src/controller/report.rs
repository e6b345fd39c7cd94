//! What a run is summed up to.

use serde::Serialize;

use rcwm_models::bundle::Manifest;
use rcwm_models::tasks::task_name;
use rcwm_models::wire::{Observation, ObservationFlags};

use super::{Arrival, Ended};
use crate::EngineKind;
use crate::telemetry::{Latency, table};

/// Everything that is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counters {
    /// Observations received, repeated and stale ones included.
    pub observations: u64,
    /// Actions sent, repeated ones included.
    pub answers: u64,
    /// Answers that were the fallback action.
    pub fallback_answers: u64,
    /// Observations that had been answered before and got the same answer again.
    pub repeated_observations: u64,
    /// Observations older than the last, dropped.
    pub stale_observations: u64,
    /// Observations that were published but never seen (real time: overwritten by a later one).
    pub missed_observations: u64,
    /// Observations refused because they held numbers that are not finite.
    pub refused_observations: u64,
    /// Ticks whose outputs were not finite.
    pub non_finite_outputs: u64,
    /// Ticks on which the engine failed.
    pub engine_errors: u64,
    /// Actions published later than a period after their observation was due (real time).
    pub missed_deadlines: u64,
    /// Those of them that were answered within a period: the simulator itself had published late.
    pub missed_deadlines_published_late: u64,
    /// Another simulator took over the instance.
    pub peer_restarts: u64,
    /// Policies taken over while running.
    pub swaps: u64,
}

impl Counters {
    pub(super) fn note(&mut self, arrival: Arrival) {
        self.observations += 1;
        match arrival {
            Arrival::Joined { restarted } => self.peer_restarts += u64::from(restarted),
            Arrival::Next { missed, .. } => self.missed_observations += missed,
            Arrival::Repeated => self.repeated_observations += 1,
            Arrival::Stale => self.stale_observations += 1,
        }
    }
}

/// Pace of the simulator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "mode", rename_all = "lowercase")]
pub enum Pace {
    /// It waits for every answer.
    Lockstep,
    /// It steps on a clock.
    Realtime {
        /// Steps a second.
        rate_hz: f64,
    },
}

impl Pace {
    pub(super) fn of(period_ns: u64) -> Self {
        match period_ns {
            0 => Self::Lockstep,
            period_ns => Self::Realtime { rate_hz: 1e9 / period_ns as f64 },
        }
    }
}

impl std::fmt::Display for Pace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Lockstep => f.write_str("lock-step"),
            Self::Realtime { rate_hz } => write!(f, "real time at {rate_hz:.4} Hz"),
        }
    }
}

/// One episode.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EpisodeResult {
    /// Its number at the simulator.
    pub episode: u64,
    /// Its task.
    pub task: &'static str,
    /// Step of the last observation received; the first of an episode is step 0.
    pub steps: u32,
    /// Sum of rewards.
    #[serde(rename = "return")]
    pub return_sum: f64,
    /// The task counted as solved at some step.
    pub success: bool,
    /// Seen from its first observation on.
    pub from_first: bool,
    /// Seen from its first to its last observation.
    pub whole: bool,
}

impl EpisodeResult {
    pub(super) fn start(observation: &Observation) -> Self {
        Self {
            episode: observation.episode,
            task: task_name(observation.task),
            steps: 0,
            return_sum: 0.0,
            success: false,
            from_first: observation.is(ObservationFlags::FIRST),
            whole: false,
        }
    }

    pub(super) fn add(&mut self, observation: &Observation) {
        self.steps = observation.step;
        self.success |= observation.is(ObservationFlags::SUCCESS);
        if observation.reward.is_finite() {
            self.return_sum += f64::from(observation.reward);
        }
    }
}

/// A run, as printed and as written with `--json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunReport {
    /// Task of the bundle.
    pub bundle_task: String,
    /// Preset of the bundle.
    pub preset: String,
    /// Engine that ran it.
    pub engine: EngineKind,
    /// The link's instance.
    pub instance: String,
    /// Pace of the simulator, as of the last observation.
    pub pace: Option<Pace>,
    /// Why the run ended.
    pub ended: Ended,
    /// Episodes seen from first to last.
    pub whole_episodes: usize,
    /// Those of them that were successful.
    pub successes: usize,
    /// Mean return of the whole episodes.
    pub return_mean: Option<f64>,
    /// Counts.
    pub counters: Counters,
    /// Frames that were not recorded because the recorder could not keep up.
    pub frames_dropped: u64,
    /// Percentiles per stage.
    pub latency: Vec<Latency>,
    /// Every episode, cut ones included.
    pub episodes: Vec<EpisodeResult>,
}

impl RunReport {
    pub(super) fn new(
        manifest: &Manifest,
        engine: EngineKind,
        instance: String,
        pace: Option<Pace>,
        ended: Ended,
        counters: &Counters,
        episodes: Vec<EpisodeResult>,
    ) -> Self {
        let whole: Vec<_> = episodes.iter().filter(|episode| episode.whole).collect();
        let sum: f64 = whole.iter().map(|episode| episode.return_sum).sum();
        Self {
            bundle_task: manifest.task.clone(),
            preset: manifest.provenance.preset.clone(),
            engine,
            instance,
            pace,
            ended,
            whole_episodes: whole.len(),
            successes: whole.iter().filter(|episode| episode.success).count(),
            return_mean: (!whole.is_empty()).then(|| sum / whole.len() as f64),
            counters: *counters,
            frames_dropped: 0,
            latency: Vec::new(),
            episodes,
        }
    }

    pub(super) fn with_latencies(mut self, latency: Vec<Latency>) -> Self {
        self.latency = latency;
        self
    }

    /// The summary for people.
    #[must_use]
    pub fn summary(&self) -> String {
        let pace = self.pace.map_or_else(|| "no observation".to_owned(), |pace| pace.to_string());
        let mut text = format!(
            "run        {} bundle for {}, engine {}, instance {:?}, {pace}\n",
            self.preset, self.bundle_task, self.engine, self.instance
        );
        text += &self.episode_lines();
        text += &self.counter_lines();
        text + &table(&self.latency)
    }

    fn episode_lines(&self) -> String {
        let cut = self.episodes.len() - self.whole_episodes;
        let mut text = format!("episodes   {} whole", self.whole_episodes);
        if cut > 0 {
            text += &format!(", {cut} cut");
        }
        text += &format!("; success {}/{}", self.successes, self.whole_episodes);
        if let Some(mean) = self.return_mean {
            text += &format!("; mean return {mean:.2}");
        }
        text.push('\n');
        const SHOWN_MAX: usize = 20;
        for episode in self.episodes.iter().take(SHOWN_MAX) {
            text += &format!("  {}\n", episode.line());
        }
        if self.episodes.len() > SHOWN_MAX {
            text += &format!("  ... {} more (see --json)\n", self.episodes.len() - SHOWN_MAX);
        }
        text
    }

    fn counter_lines(&self) -> String {
        let c = &self.counters;
        let mut text = format!(
            "counts     observations {}, answers {}, repeated {}, stale {}, missed observations {}, missed deadlines {} ({} \
             of them published late), peer restarts {}\n",
            c.observations,
            c.answers,
            c.repeated_observations,
            c.stale_observations,
            c.missed_observations,
            c.missed_deadlines,
            c.missed_deadlines_published_late,
            c.peer_restarts
        );
        text += &format!(
            "safety     fallback answers {}, non-finite outputs {}, refused observations {}, engine errors {}\n",
            c.fallback_answers, c.non_finite_outputs, c.refused_observations, c.engine_errors
        );
        if c.swaps > 0 {
            text += &format!("swaps      {} policies taken over while running\n", c.swaps);
        }
        if self.frames_dropped > 0 {
            text += &format!("recording  {} frames dropped\n", self.frames_dropped);
        }
        text
    }
}

impl EpisodeResult {
    /// One line for people.
    #[must_use]
    pub fn line(&self) -> String {
        let Self { episode, task, steps, return_sum, success, whole, .. } = self;
        let outcome = if *success { "success" } else { "no success" };
        let cut = if *whole { "" } else { " (cut)" };
        format!("episode {episode:<3} {task:<20} {steps:>4} steps  return {return_sum:>9.2}  {outcome}{cut}")
    }
}
