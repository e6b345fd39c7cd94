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
        for (stage, time_ns) in stage_times(record) {
            self.telemetry.record(stage, time_ns);
        }
        self.report.overtaken += u64::from(record.overtaken);
        if let Some(period_ns) = period_ns(record).filter(|_| !record.overtaken) {
            let late = record.answer.published_ns.saturating_sub(record.scheduled_ns) > period_ns;
            self.report.period_us = Some(period_ns as f64 / 1e3);
            self.report.late_answers += u64::from(late);
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

/// The control period where the observation came by a clock. One that was sent again for us is older than we are.
fn period_ns(record: &TickRecord) -> Option<u64> {
    let Observed { period_ns, flags, .. } = record.observed.as_ref()?;
    let repeated = ObservationFlags(*flags).contains(ObservationFlags::REPEATED);
    (*period_ns > 0 && !repeated).then_some(*period_ns)
}

/// Every time that a tick says, in ns. What was worked ahead took no time in the tick, and an answer that was not sent has none.
pub(crate) fn stage_times(record: &TickRecord) -> Vec<(Stage, u64)> {
    let mut times = Vec::new();
    for call in &record.calls {
        match &call.outcome {
            LoggedOutcome::Decided { stage_ns, .. } => {
                let stages = Stage::POLICY.into_iter().zip(stage_ns.iter().copied());
                times.extend(stages.filter(|(_, time_ns)| *time_ns > 0));
            }
            LoggedOutcome::Done(time_ns) => times.push((Stage::Ahead, *time_ns)),
            LoggedOutcome::StateSet(_) | LoggedOutcome::Failed(_) => {}
        }
    }
    if record.overtaken {
        return times;
    }
    let TickRecord { scheduled_ns, received_ns, answer, .. } = record;
    let since = |ns: u64| answer.published_ns.saturating_sub(ns);
    let Some(Observed { published_ns, .. }) = record.observed else {
        times.extend([(Stage::Imagine, since(*received_ns)), (Stage::FromSchedule, since(*scheduled_ns))]);
        return times;
    };
    times.push((Stage::Receive, received_ns.saturating_sub(published_ns)));
    times.extend([(Stage::Tick, since(*received_ns)), (Stage::EndToEnd, since(published_ns))]);
    if period_ns(record).is_some() {
        times.push((Stage::PublishLag, published_ns.saturating_sub(*scheduled_ns)));
        times.push((Stage::FromSchedule, since(*scheduled_ns)));
    }
    times
}
