//! The live line of `run`: drawn by its own thread, so that a slow terminal never holds up a tick.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rcwm_models::terminal::LINE_EVERY;

use super::remarks::Remarks;
use crate::controller::{Tick, TickObserver};
use crate::telemetry::Stage;

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

/// The loop's end of the live line.
pub(super) struct StatusLine {
    messages: Option<SyncSender<Message>>,
    thread: Option<JoinHandle<()>>,
    last: Instant,
    last_observations: u64,
    reported: u64,
    clock_ahead: bool,
    remarks: Remarks,
}

impl StatusLine {
    pub(super) fn start(waiting_for: &str) -> std::io::Result<Self> {
        let (messages, received) = sync_channel(WAITING_MAX);
        let waiting = format!("waiting for an observation on instance {waiting_for:?}");
        let thread =
            std::thread::Builder::new().name("status".into()).spawn(move || draw(&received, waiting))?;
        Ok(Self {
            messages: Some(messages),
            thread: Some(thread),
            last: Instant::now(),
            last_observations: 0,
            reported: 0,
            clock_ahead: false,
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

    fn status(&mut self, tick: &Tick<'_>) -> String {
        let elapsed_s = self.last.elapsed().as_secs_f64();
        let rate_hz = (tick.counters.observations - self.last_observations) as f64 / elapsed_s;
        let latency = tick.telemetry.latency(Stage::EndToEnd);
        let running = tick.running;
        format!(
            "episode {} step {} return {:.1}{} | {} done, {} solved | p50 {:.0} us p99 {:.0} us | {rate_hz:.1} Hz",
            running.episode,
            running.steps,
            running.return_sum,
            if running.success { " success" } else { "" },
            tick.episodes.whole(),
            tick.episodes.successes(),
            latency.p50_us,
            latency.p99_us,
        )
    }
}

impl TickObserver for StatusLine {
    fn ticked(&mut self, tick: &Tick<'_>) {
        for episode in tick.episodes.since(self.reported) {
            self.send(Message::Line(episode.line()));
        }
        self.reported = tick.episodes.ended();
        if tick.counters.clock_ahead > 0 && !std::mem::replace(&mut self.clock_ahead, true) {
            let said = "the robot's clock is ahead of this machine's CLOCK_MONOTONIC: its times are taken as those of receiving";
            self.send(Message::Line(said.into()));
        }
        let Self { remarks, messages, .. } = self;
        for remark in remarks.of(tick) {
            // If the drawing thread is gone or held up there is nothing to draw on.
            let _ =
                messages.as_ref().map(|messages| messages.try_send(Message::Line(format!("note: {remark}"))));
        }
        if self.last.elapsed() >= UPDATE {
            let status = self.status(tick);
            self.send(Message::Status(status));
            (self.last, self.last_observations) = (Instant::now(), tick.counters.observations);
        }
    }
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
