//! The times that a log holds.

use rcwm_models::wire::ObservationFlags;
use serde::Serialize;

use rcwm_runtime::log::{Entry, LogError, LogReader, LoggedOutcome, Observed, TickRecord};
use rcwm_runtime::telemetry::{Latency, Stage, Telemetry, table};

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
    pub late_answers: u64,
    /// Answers that were not sent because a newer observation had come before they were ready.
    pub overtaken: u64,
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
            late_answers: 0,
            overtaken: 0,
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
        self.report.ticks_dropped = self.report.ticks_dropped.saturating_add(record.dropped_before);
        for call in &record.calls {
            match &call.outcome {
                LoggedOutcome::Decided { stage_ns, .. } => self.telemetry.record_policy(stage_ns),
                LoggedOutcome::Done(time_ns) => self.telemetry.record(Stage::Ahead, *time_ns),
                _ => {}
            }
        }
        if record.overtaken {
            self.report.overtaken += 1;
            return;
        }
        let TickRecord { scheduled_ns, received_ns, .. } = *record;
        let sent_ns = record.answer.published_ns;
        let from_schedule_ns = sent_ns.saturating_sub(scheduled_ns);
        let Some(observed) = &record.observed else {
            self.telemetry.record(Stage::Imagine, sent_ns.saturating_sub(received_ns));
            self.telemetry.record(Stage::FromSchedule, from_schedule_ns);
            return;
        };
        let Observed { published_ns, period_ns, .. } = *observed;
        self.telemetry.record(Stage::Receive, received_ns.saturating_sub(published_ns));
        self.telemetry.record(Stage::Tick, sent_ns.saturating_sub(received_ns));
        self.telemetry.record(Stage::EndToEnd, sent_ns.saturating_sub(published_ns));
        // One that was sent again for us is older than we are.
        if period_ns > 0 && !ObservationFlags(observed.flags).contains(ObservationFlags::REPEATED) {
            self.report.period_us = Some(period_ns as f64 / 1e3);
            self.telemetry.record(Stage::PublishLag, published_ns.saturating_sub(scheduled_ns));
            self.telemetry.record(Stage::FromSchedule, from_schedule_ns);
            self.report.late_answers += u64::from(from_schedule_ns > period_ns);
        }
    }

    /// The summary for people.
    #[must_use]
    pub fn text(&self) -> String {
        let LoggedLatencyReport { ticks, ticks_dropped, period_us, late_answers, overtaken, latency, .. } =
            &self.report;
        let pace = match period_us {
            Some(period_us) => {
                format!(
                    "real time, a period of {period_us:.1} us, {late_answers} answers late, {overtaken} overtaken"
                )
            }
            None => "lock-step".to_owned(),
        };
        format!("log        {ticks} ticks, {ticks_dropped} dropped; {pace}\n{}", table(latency))
    }
}
