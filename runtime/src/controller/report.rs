//! What a run is summed up to.

use serde::Serialize;

use rcwm_models::bundle::Manifest;

use super::{Arrival, BranchSurprise, Ended, EpisodeResult, Episodes, State, SurpriseReport};
use crate::EngineKind;
use crate::realtime::Granted;
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
    /// Answers to ticks whose observation had not come, on what the world model imagined.
    pub imagined_answers: u64,
    /// Observations older than the last, or scheduled too long ago, dropped.
    pub stale_observations: u64,
    /// Observations that came after their tick had been imagined; the state went back for them.
    pub late_observations: u64,
    /// Observations that were published but never seen (real time: overwritten by a later one, or lost).
    pub missed_observations: u64,
    /// Observations refused because they held numbers that are not finite, or an executed action out of range.
    pub refused_observations: u64,
    /// Ticks whose outputs were not finite.
    pub non_finite_outputs: u64,
    /// Ticks on which the engine failed.
    pub engine_errors: u64,
    /// Ticks after which the robot branch was more surprised than allowed.
    pub robot_surprises: u64,
    /// The same of the environment branch.
    pub environment_surprises: u64,
    /// The same of a world model of one branch.
    pub dynamics_surprises: u64,
    /// Ticks whose work ahead was for another action than was executed, and was done again.
    pub recomputed: u64,
    /// Ticks for which the second thread came too late, so that the first computed its branch too.
    pub helper_late: u64,
    /// Actions that the rate limit has changed.
    pub rate_limited: u64,
    /// Answers that were not sent because a newer observation had come before they were ready.
    pub overtaken_answers: u64,
    /// Ticks without an observation that were slept through and not made up for.
    pub skipped_ticks: u64,
    /// Observations published later than a period after they were due: the simulator's own lateness (real time).
    pub published_late: u64,
    /// Actions published later than a period after their observation was due, or never (real time).
    pub missed_deadlines: u64,
    /// Those of them that were answered within a period: the simulator itself had published late.
    pub missed_deadlines_published_late: u64,
    /// Another simulator took over the instance.
    pub peer_restarts: u64,
    /// A peer was silent for so long that the controller fell silent too.
    pub peers_lost: u64,
    /// Policies taken over while running.
    pub swaps: u64,
    /// Observations that were scheduled or published later than they were received: the peer's clock is ahead.
    pub clock_ahead: u64,
    /// Answers that were not sent because there was nothing valid to send, nor anything known that could be held.
    pub withheld_answers: u64,
}

impl Counters {
    pub(super) fn note(&mut self, arrival: Arrival) {
        self.observations += 1;
        match arrival {
            Arrival::Joined { restarted } => self.peer_restarts += u64::from(restarted),
            // What a peer says may be any number.
            Arrival::Next { missed, .. } => {
                self.missed_observations = self.missed_observations.saturating_add(missed);
            }
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

/// A run, as printed and as written with `--json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunReport {
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
    pub whole_episodes: u64,
    /// Those of them that were successful.
    pub successes: u64,
    /// Mean return of the whole episodes.
    pub return_mean: Option<f64>,
    /// What the controller was up to in the end.
    pub last_state: State,
    /// Counts.
    pub counters: Counters,
    /// How surprised the branches were; none without a tick that tells.
    pub surprise: Option<SurpriseReport>,
    /// What the system granted the loop's thread.
    pub realtime: Option<Granted>,
    /// What does not fit between robot and policy, for people.
    pub remarks: Vec<String>,
    /// Ticks that are missing in the log because the writer could not keep up.
    pub frames_dropped: u64,
    /// Percentiles per stage.
    pub latency: Vec<Latency>,
    /// The last episodes, cut ones included, at most [`super::EPISODES_KEPT`].
    pub episodes: Vec<EpisodeResult>,
    /// Episodes before them.
    pub earlier_episodes: u64,
}

impl RunReport {
    pub(super) fn new(
        manifest: &Manifest,
        engine: EngineKind,
        instance: String,
        pace: Option<Pace>,
        ended: Ended,
        counters: &Counters,
        episodes: &Episodes,
    ) -> Self {
        let last: Vec<_> = episodes.since(0).copied().collect();
        Self {
            bundle_task: manifest.task.clone(),
            preset: manifest.provenance.preset.clone(),
            engine,
            instance,
            pace,
            ended,
            whole_episodes: episodes.whole(),
            successes: episodes.successes(),
            return_mean: episodes.return_mean(),
            last_state: State::Waiting,
            counters: *counters,
            surprise: None,
            realtime: None,
            remarks: Vec::new(),
            frames_dropped: 0,
            latency: Vec::new(),
            earlier_episodes: episodes.ended() - last.len() as u64,
            episodes: last,
        }
    }

    /// The summary for people.
    #[must_use]
    pub fn summary(&self) -> String {
        let pace = self.pace.map_or_else(|| "no observation".to_owned(), |pace| pace.to_string());
        let mut text = format!(
            "run        {} bundle for {}, engine {}, instance {:?}, {pace}\n",
            self.preset, self.bundle_task, self.engine, self.instance
        );
        for remark in &self.remarks {
            text += &format!("note       {remark}\n");
        }
        text += &self.episode_lines();
        text += &self.counter_lines();
        text + &table(&self.latency)
    }

    fn episode_lines(&self) -> String {
        let all = self.earlier_episodes + self.episodes.len() as u64;
        let cut = all - self.whole_episodes;
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
        if all > SHOWN_MAX as u64 {
            text += &format!("  ... {} more (see --json, which has the last ones)\n", all - SHOWN_MAX as u64);
        }
        text
    }

    fn counter_lines(&self) -> String {
        let c = &self.counters;
        let mut text = format!(
            "counts     observations {}, answers {}, repeated {}, stale {}, missed observations {}, recomputed {}, second \
             thread late {}, peer restarts {}, peers lost {}\n",
            c.observations,
            c.answers,
            c.repeated_observations,
            c.stale_observations,
            c.missed_observations,
            c.recomputed,
            c.helper_late,
            c.peer_restarts,
            c.peers_lost
        );
        text += &format!(
            "time       missed deadlines {} ({} of them published late), observations published late {}, overtaken {}, \
             skipped {}\n",
            c.missed_deadlines,
            c.missed_deadlines_published_late,
            c.published_late,
            c.overtaken_answers,
            c.skipped_ticks
        );
        text += &format!(
            "safety     fallback answers {}, imagined {} (seen after all {}), non-finite outputs {}, refused observations {}, \
             engine errors {}, rate-limited {}\n",
            c.fallback_answers,
            c.imagined_answers,
            c.late_observations,
            c.non_finite_outputs,
            c.refused_observations,
            c.engine_errors,
            c.rate_limited
        );
        if c.clock_ahead > 0 {
            text += &format!(
                "clock      {} observations were scheduled or published later than they were received: the robot's clock is \
                 ahead; use CLOCK_MONOTONIC of this machine\n",
                c.clock_ahead
            );
        }
        if c.withheld_answers > 0 {
            text += &format!(
                "withheld   {} answers: nothing valid to send, and no position known that could be held\n",
                c.withheld_answers
            );
        }
        text += &self.surprise_line();
        for line in self.realtime.iter().flat_map(Granted::lines) {
            text += &format!("realtime   {line}\n");
        }
        if c.swaps > 0 {
            text += &format!("swaps      {} policies taken over while running\n", c.swaps);
        }
        if self.frames_dropped > 0 {
            text += &format!(
                "recording  {} ticks are missing in the log: the writer could not keep up\n",
                self.frames_dropped
            );
        }
        text
    }

    fn surprise_line(&self) -> String {
        let Some(report) = self.surprise else { return String::new() };
        let c = &self.counters;
        let branches = [
            ("robot ", report.robot, c.robot_surprises),
            ("environment ", report.environment, c.environment_surprises),
            // There is no other to tell it from.
            ("", report.dynamics, c.dynamics_surprises),
        ];
        let said = branches.into_iter().filter_map(|(name, branch, over)| {
            let BranchSurprise { p50_nats, p99_nats, max_nats } = branch?;
            Some(format!("{name}p50 {p50_nats:.2} p99 {p99_nats:.2} max {max_nats:.2} nats ({over} over)"))
        });
        format!("surprise   {}\n", said.collect::<Vec<_>>().join(", "))
    }
}
