//! The times that a log holds.

use serde::Serialize;

use super::LogError;
use super::reader::{Entry, LogReader};
use super::record::{LoggedOutcome, TickRecord};
use crate::telemetry::{Latency, Stage, Telemetry, table};

/// Times of a logged run.
pub struct LoggedLatencies {
    /// Every time.
    pub telemetry: Telemetry,
    /// The summary.
    pub report: LoggedLatencyReport,
}

/// Times of a logged run, summed up.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LoggedLatencyReport {
    /// Ticks in the log.
    pub ticks: u64,
    /// Ticks that the log says were dropped.
    pub ticks_dropped: u64,
    /// The control period, in us; none in lock-step.
    pub period_us: Option<f64>,
    /// Answers published later than a period after their observation was due.
    pub missed_deadlines: u64,
    /// Where the log is damaged; all before it was read.
    pub log_damage: Option<String>,
    /// Percentiles per stage.
    pub latency: Vec<Latency>,
}

impl LoggedLatencies {
    /// Reads a log to its end; `go_on` is asked after every entry with the bytes read and in all.
    ///
    /// # Errors
    /// [`LogError::Io`]. Damage is no error: it is in the report.
    pub fn read(log: &mut LogReader, go_on: &mut dyn FnMut((u64, u64)) -> bool) -> Result<Self, LogError> {
        let report = LoggedLatencyReport {
            ticks: 0,
            ticks_dropped: 0,
            period_us: None,
            missed_deadlines: 0,
            log_damage: None,
            latency: Vec::new(),
        };
        let mut this = Self { telemetry: Telemetry::new(), report };
        loop {
            match log.read() {
                Ok(Some(Entry::Tick(tick))) => this.add(&tick.record),
                Ok(Some(Entry::Policy(_))) => {}
                Ok(None) => break,
                Err(error @ LogError::Damaged { .. }) => {
                    this.report.log_damage = Some(error.to_string());
                    break;
                }
                Err(error) => return Err(error),
            }
            if !go_on(log.progress_bytes()) {
                break;
            }
        }
        this.report.latency = this.telemetry.latencies();
        Ok(this)
    }

    fn add(&mut self, record: &TickRecord) {
        self.report.ticks += 1;
        self.report.ticks_dropped += record.dropped_before;
        for call in &record.calls {
            if let LoggedOutcome::Decided { stage_ns, .. } = &call.outcome {
                for (stage, time_ns) in Stage::POLICY.into_iter().zip(stage_ns) {
                    self.telemetry.record(stage, *time_ns);
                }
            }
        }
        let Some(observed) = &record.observed else { return };
        let (received_ns, sent_ns) = (record.received_ns, record.answer.published_ns);
        self.telemetry.record(Stage::Receive, received_ns.saturating_sub(observed.published_ns));
        self.telemetry.record(Stage::Tick, sent_ns.saturating_sub(received_ns));
        self.telemetry.record(Stage::EndToEnd, sent_ns.saturating_sub(observed.published_ns));
        let period_ns = observed.period_ns;
        if period_ns > 0 {
            self.report.period_us = Some(period_ns as f64 / 1e3);
            let due_ns = observed.scheduled_ns.saturating_add(period_ns);
            self.report.missed_deadlines += u64::from(sent_ns > due_ns);
        }
    }

    /// The summary for people.
    #[must_use]
    pub fn text(&self) -> String {
        let LoggedLatencyReport { ticks, ticks_dropped, period_us, missed_deadlines, latency, .. } =
            &self.report;
        let pace = match period_us {
            Some(period_us) => {
                format!("real time, a period of {period_us:.1} us, {missed_deadlines} deadlines missed")
            }
            None => "lock-step".to_owned(),
        };
        format!("log        {ticks} ticks, {ticks_dropped} dropped; {pace}\n{}", table(latency))
    }
}
