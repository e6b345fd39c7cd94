//! A stream of recorded images at a fixed rate, and what was answered when.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::Context;
use rcwm_models::IMAGE_BYTES;
use rcwm_models::bundle::Bundle;
use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{Action, ActionSource, ActionValues, ObservationFlags, SimulatorLink, Wait};
use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec};
use serde::Serialize;

/// What came of one phase.
#[derive(Debug, Clone, Default, Serialize)]
pub struct PhaseReport {
    /// Its name.
    pub phase: String,
    /// Observations published.
    pub observations: u64,
    /// Answered by the policy within a period of when they were due.
    pub in_time: u64,
    /// Answered later, or not at all.
    pub missed: u64,
    /// Those of them that were answered within a period of being published: the stream itself was late.
    pub missed_published_late: u64,
    /// Answered by something else than the policy.
    pub not_by_policy: u64,
    /// From publishing to the action's publishing, in us.
    pub latency_us: Percentiles,
    #[serde(skip)]
    latencies_ns: Vec<u64>,
}

/// Percentiles of a phase.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Percentiles {
    /// Median.
    pub p50: f64,
    /// 99 of 100 are at most this.
    pub p99: f64,
    /// 999 of 1000 are at most this.
    pub p99_9: f64,
    /// Longest.
    pub max: f64,
}

/// What the robot sends.
pub struct Stream<'a> {
    peer: &'a SimulatorLink,
    images: Vec<[u8; IMAGE_BYTES]>,
    period_ns: u64,
    episode: u64,
    sequence: u64,
    last_action: ActionValues,
    /// When what was not answered in time was published, by sequence.
    unanswered: HashMap<u64, u64>,
}

impl<'a> Stream<'a> {
    /// The images are those of the bundle's golden values.
    ///
    /// # Errors
    /// If the bundle has none, or no robot has such a rate.
    pub fn new(peer: &'a SimulatorLink, bundle: &Bundle, rate_hz: f64, episode: u32) -> anyhow::Result<Self> {
        let images = bundle.golden.u8("input/image")?;
        let bytes = images.as_slice().context("golden images lie in order")?;
        let images = bytes.as_chunks::<IMAGE_BYTES>().0.to_vec();
        anyhow::ensure!(!images.is_empty(), "the bundle has no golden image");
        anyhow::ensure!((1.0..=10_000.0).contains(&rate_hz), "--rate-hz {rate_hz}: expected 1 to 10000");
        let period_ns = (1e9 / rate_hz) as u64;
        let (episode, unanswered) = (u64::from(episode), HashMap::new());
        Ok(Self {
            peer,
            images,
            period_ns,
            episode,
            sequence: 0,
            last_action: ActionValues::zeros(4),
            unanswered,
        })
    }

    fn publish(&mut self, scheduled_ns: u64, repeated: bool) -> anyhow::Result<()> {
        let step = self.sequence % self.episode;
        let image = self.images[(self.sequence % self.images.len() as u64) as usize];
        let flags = ObservationFlags::default()
            .with(ObservationFlags::FIRST, step == 0)
            .with(ObservationFlags::LAST, step + 1 == self.episode)
            .with(ObservationFlags::REPEATED, repeated);
        self.peer.publish(|slot| {
            (slot.sequence, slot.episode, slot.step) =
                (self.sequence, self.sequence / self.episode, step as u32);
            (slot.scheduled_ns, slot.period_ns, slot.flags) = (scheduled_ns, self.period_ns, flags.0);
            if step > 0 {
                slot.executed().copy_from_slice(&self.last_action);
            }
            slot.image(0).copy_from_slice(&image);
        })?;
        Ok(())
    }

    /// Sends the first observation until somebody answers it.
    ///
    /// # Errors
    /// Those of the link; or nobody answers within a minute.
    pub fn wait_for_controller(&mut self, stop: &AtomicBool) -> anyhow::Result<()> {
        for _ in 0..600 {
            anyhow::ensure!(!stop.load(Ordering::Relaxed), "interrupted");
            self.publish(monotonic_ns(), true)?;
            if let (Wait::Message(_), _) = self.peer.wait_action(Duration::from_millis(100))? {
                self.sequence += 1;
                return Ok(());
            }
        }
        anyhow::bail!("the run did not answer within 60 s")
    }

    /// Plays until `done`; what happens is counted to the phase that is.
    ///
    /// # Errors
    /// Those of the link.
    pub fn play(
        &mut self,
        phases: &[&str],
        phase: &AtomicUsize,
        done: &AtomicBool,
    ) -> anyhow::Result<Vec<PhaseReport>> {
        let named = |name: &&str| PhaseReport { phase: (*name).to_owned(), ..PhaseReport::default() };
        let mut reports: Vec<_> = phases.iter().map(named).collect();
        let mut due_ns = monotonic_ns() + self.period_ns;
        while !done.load(Ordering::Relaxed) {
            sleep_until(due_ns);
            let report = &mut reports[phase.load(Ordering::Relaxed).min(phases.len() - 1)];
            self.tick(due_ns, report)?;
            self.sequence += 1;
            // A tick that this stream itself has slept through is not made up for by a burst.
            let now = monotonic_ns();
            due_ns += self.period_ns;
            while due_ns + self.period_ns < now {
                due_ns += self.period_ns;
            }
        }
        reports.iter_mut().for_each(PhaseReport::sum_up);
        Ok(reports)
    }

    fn tick(&mut self, due_ns: u64, report: &mut PhaseReport) -> anyhow::Result<()> {
        let published_ns = monotonic_ns();
        self.publish(due_ns, false)?;
        report.observations += 1;
        let deadline_ns = due_ns + self.period_ns;
        loop {
            let left = Duration::from_nanos(deadline_ns.saturating_sub(monotonic_ns()));
            match self.peer.wait_action(left)?.0 {
                Wait::Message(action) if action.answers == self.sequence => {
                    self.last_action = action.action;
                    report.latencies_ns.push(action.published_ns.saturating_sub(published_ns));
                    report.not_by_policy += u64::from(action.source != ActionSource::Policy as u32);
                    if action.published_ns <= deadline_ns {
                        report.in_time += 1;
                        return Ok(());
                    }
                    self.unanswered.insert(self.sequence, published_ns);
                    self.note_late(&action, report);
                    report.missed += 1;
                    return Ok(());
                }
                Wait::Message(action) => self.note_late(&action, report),
                _ if monotonic_ns() >= deadline_ns => break,
                _ => {}
            }
        }
        self.unanswered.insert(self.sequence, published_ns);
        report.missed += 1;
        Ok(())
    }

    /// An answer after its deadline: whose fault was it?
    fn note_late(&mut self, action: &Action, report: &mut PhaseReport) {
        if let Some(published_ns) = self.unanswered.remove(&action.answers) {
            let in_time = action.published_ns <= published_ns + self.period_ns;
            report.missed_published_late += u64::from(in_time);
        }
    }
}

impl PhaseReport {
    fn sum_up(&mut self) {
        self.latencies_ns.sort_unstable();
        let at = |share: f64| {
            let last = self.latencies_ns.len().saturating_sub(1);
            self.latencies_ns
                .get((share * last as f64).round() as usize)
                .map_or(f64::NAN, |ns| *ns as f64 / 1e3)
        };
        self.latency_us = Percentiles { p50: at(0.5), p99: at(0.99), p99_9: at(0.999), max: at(1.0) };
    }

    /// One line for people.
    #[must_use]
    pub fn text(&self) -> String {
        let Self { phase, observations, missed, missed_published_late, not_by_policy, latency_us: l, .. } =
            self;
        format!(
            "{phase:<14} {observations} observations, {missed} missed ({missed_published_late} published late), \
             {not_by_policy} not by the policy; p50 {:.0} us, p99 {:.0} us, p99.9 {:.0} us, max {:.0} us\n",
            l.p50, l.p99, l.p99_9, l.max
        )
    }
}

fn sleep_until(time_ns: u64) {
    const NS_PER_S: u64 = 1_000_000_000;
    let time = Timespec { tv_sec: (time_ns / NS_PER_S) as i64, tv_nsec: (time_ns % NS_PER_S) as i64 };
    // A signal ends the sleep early: the time is absolute, so sleeping again is exact.
    while monotonic_ns() < time_ns {
        if clock_nanosleep_absolute(ClockId::Monotonic, &time).is_ok() {
            break;
        }
    }
}
