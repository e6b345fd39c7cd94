//! The live line of `run`: drawn by a thread of its own, so that a slow terminal holds up neither a tick nor a log.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::bundle::Manifest;
use rcwm_models::terminal::LINE_EVERY;

use super::remarks::Remarks;
use crate::record::{Record, Sink};
use crate::telemetry::{Stage, Telemetry};

/// Time between two updates of the line.
const UPDATE: Duration = Duration::from_millis(200);
/// Messages that wait to be drawn; a terminal that does not drain loses those beyond.
const WAITING_MAX: usize = 256;
/// How long the end of a run waits for a terminal.
const TIMEOUT: Duration = Duration::from_secs(1);

enum Message {
    Status(String),
    Line(String),
}

/// The live line, made from the records.
pub(super) struct StatusLine {
    messages: Option<SyncSender<Message>>,
    thread: Option<JoinHandle<()>>,
    last: Instant,
    last_observations: u64,
    clock_ahead: bool,
    latencies: Telemetry,
    manifest: Manifest,
    remarks: Remarks,
}

impl StatusLine {
    pub(super) fn start(waiting_for: &str, manifest: &Manifest) -> std::io::Result<Self> {
        let (messages, received) = sync_channel(WAITING_MAX);
        let waiting = format!("waiting for an observation on instance {waiting_for:?}");
        let thread =
            std::thread::Builder::new().name("status".into()).spawn(move || draw(&received, waiting))?;
        Ok(Self {
            messages: Some(messages),
            thread: Some(thread),
            last: Instant::now(),
            last_observations: 0,
            clock_ahead: false,
            latencies: Telemetry::new(),
            manifest: manifest.clone(),
            remarks: Remarks::default(),
        })
    }

    /// Ends drawing; gives what was remarked.
    pub(super) fn finish(mut self) -> Vec<String> {
        self.remarks.take()
    }

    fn send(&self, message: Message) {
        if let Some(messages) = &self.messages {
            // If the drawing thread is gone or held up there is nothing to draw on.
            let _ = messages.try_send(message);
        }
    }

    fn status(&self, record: &Record) -> String {
        let elapsed_s = self.last.elapsed().as_secs_f64();
        let rate_hz = (record.counters.observations - self.last_observations) as f64 / elapsed_s;
        let latency = self.latencies.latency(Stage::EndToEnd);
        let Record { running, whole: [whole, solved], .. } = record;
        format!(
            "episode {} step {} return {:.1}{} | {whole} done, {solved} solved | p50 {:.0} us p99 {:.0} us | {rate_hz:.1} Hz",
            running.episode,
            running.steps,
            running.return_sum,
            if running.success { " success" } else { "" },
            latency.p50_us,
            latency.p99_us,
        )
    }
}

impl Sink for StatusLine {
    fn wants_pictures(&self) -> bool {
        false
    }

    fn take(&mut self, record: &Record) {
        for (stage, time_ns) in &record.recordings {
            self.latencies.record(*stage, *time_ns);
        }
        for episode in &record.ended {
            self.send(Message::Line(episode.line()));
        }
        if record.counters.clock_ahead > 0 && !std::mem::replace(&mut self.clock_ahead, true) {
            let said = "the robot's clock is ahead of this machine's CLOCK_MONOTONIC: its times are taken as those of receiving";
            self.send(Message::Line(said.into()));
        }
        if let Some(policy) = &record.exchanged {
            self.manifest.clone_from(&policy.manifest);
        }
        let new: Vec<_> =
            self.remarks.of(record, &self.manifest).iter().map(|text| format!("note: {text}")).collect();
        new.into_iter().for_each(|line| self.send(Message::Line(line)));
        if self.last.elapsed() >= UPDATE {
            let status = self.status(record);
            self.send(Message::Status(status));
            (self.last, self.last_observations) = (Instant::now(), record.counters.observations);
        }
    }

    fn pause(&mut self, _: u64) {}
}

impl Drop for StatusLine {
    fn drop(&mut self) {
        self.messages = None;
        let Some(thread) = self.thread.take() else { return };
        let start = Instant::now();
        while !thread.is_finished() && start.elapsed() < TIMEOUT {
            std::thread::sleep(Duration::from_millis(2));
        }
        // One that a terminal holds up ends with the process. One that panicked while drawing has nothing left to clear.
        if thread.is_finished() {
            let _ = thread.join();
        }
    }
}

/// Draws until the sender is gone. Without a terminal only whole lines are printed.
fn draw(messages: &Receiver<Message>, waiting: String) {
    let bar = indicatif::ProgressBar::new_spinner();
    if bar.is_hidden() {
        rcwm_models::errln!("{waiting}");
    }
    bar.set_message(waiting);
    bar.enable_steady_tick(UPDATE);
    let mut last = Instant::now();
    while let Ok(message) = messages.recv() {
        match message {
            Message::Status(text) if bar.is_hidden() => {
                if last.elapsed() >= LINE_EVERY {
                    last = Instant::now();
                    rcwm_models::errln!("{text}");
                }
            }
            Message::Status(text) => bar.set_message(text),
            Message::Line(text) if bar.is_hidden() => rcwm_models::errln!("{text}"),
            Message::Line(text) => bar.println(rcwm_models::terminal::shown(&text)),
        }
    }
    bar.finish_and_clear();
}
