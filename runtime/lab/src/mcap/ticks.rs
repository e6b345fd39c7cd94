//! What of a tick goes to which topic.

use std::io::{self, Write};

use rcwm_models::wire::{Observation, ObservationFlags};
use rcwm_runtime::log::{BundleIdentity, Header, LoggedOutcome, LoggedTick, TickRecord};
use rcwm_runtime::policy::Surprise;

use super::bag::Bag;
use super::file::Times;
use super::messages::{Level, Schema, event, numbers, text};
use super::robot::Robot;
use crate::log::{mode, stage_times};

/// Writes the ticks of a log.
pub(super) struct Ticks<W: Write> {
    pub(super) bag: Bag<W>,
    /// Of the last observation.
    robot: Option<Robot>,
    /// What is to be added to times of the log; none before it is known.
    to_unix_ns: Option<i128>,
    started_unix_s: u64,
    /// When the last tick was received, by the log's clock.
    last_ns: u64,
    pub(super) ticks: u64,
    pub(super) episodes: u64,
    pub(super) pictures: u64,
}

impl<W: Write> Ticks<W> {
    /// Begins with what the run was made with.
    pub(super) fn start(mut bag: Bag<W>, header: &Header) -> io::Result<Self> {
        let Header {
            program, started_unix_s, monotonic_to_unix_ns, instance, bundle, engine, machine, ..
        } = header;
        let values = [
            ("program", program.clone()),
            ("instance", instance.clone()),
            ("task", bundle.task.clone()),
            ("preset", bundle.preset.clone()),
            ("engine", engine.kind.to_string()),
            ("architecture", machine.architecture.clone()),
            ("processor", machine.processor.clone()),
        ];
        let parts = bundle.sha256.iter().map(|(part, sha256)| (format!("sha256_{part}"), sha256.clone()));
        let values = values.into_iter().map(|(key, value)| (key.to_owned(), value));
        bag.properties("rcwm", &values.chain(parts).collect())?;
        Ok(Self {
            bag,
            robot: None,
            to_unix_ns: monotonic_to_unix_ns.map(i128::from),
            started_unix_s: *started_unix_s,
            last_ns: 0,
            ticks: 0,
            episodes: 0,
            pictures: 0,
        })
    }

    pub(super) fn policy(&mut self, policy: &BundleIdentity) -> io::Result<()> {
        let BundleIdentity { task, preset, .. } = policy;
        self.event(self.last_ns, Level::Info, &format!("another policy took over: {task}, {preset}"))
    }

    pub(super) fn tick(&mut self, tick: &LoggedTick) -> io::Result<()> {
        let LoggedTick { record, observation, .. } = tick;
        self.last_ns = record.received_ns;
        self.to_unix_ns.get_or_insert_with(|| {
            i128::from(self.started_unix_s) * 1_000_000_000 - i128::from(record.received_ns)
        });
        self.ticks += 1;
        self.episodes += u64::from(record.is_first);
        if record.dropped_before > 0 {
            let said = format!("{} ticks before this one are not in the log", record.dropped_before);
            self.event(record.received_ns, Level::Warn, &said)?;
        }
        if let Some(observation) = observation {
            self.observed(record, &observation.view())?;
        }
        self.answered(record)
    }

    fn observed(&mut self, record: &TickRecord, observation: &Observation<'_>) -> io::Result<()> {
        let format = observation.format();
        let robot = match self.robot.take().filter(|robot| robot.format() == format) {
            Some(robot) => robot,
            None => {
                let text = [("interface".to_owned(), format.interface().canonical())];
                self.bag.properties("rcwm_interface", &text.into())?;
                Robot::start(&mut self.bag, format)
            }
        };
        let times = self.times(record.received_ns, observation.published_ns, observation.sequence);
        let captured_ns = |camera: usize| match observation.captured_ns[camera] {
            0 => times.publish_ns,
            captured_ns => self.unix_ns(captured_ns),
        };
        let captured: Vec<_> = (0..format.interface().camera.len()).map(captured_ns).collect();
        robot.observed(&mut self.bag, times, &captured, observation)?;
        self.pictures += captured.len() as u64;
        self.robot = Some(robot);
        let numbers_of = [
            ("/rcwm/reward", observation.reward),
            ("/rcwm/episode", observation.episode as f32),
            ("/rcwm/step", observation.step as f32),
        ];
        for (topic, value) in numbers_of {
            self.number(topic, times, value)?;
        }
        let flags = ObservationFlags(observation.flags).names().collect::<Vec<_>>().join(" ");
        self.bag.write_to("/rcwm/flags", Schema::Text, times, &text(&flags))
    }

    /// Writes the answer, if it was sent, and how it came about.
    fn answered(&mut self, record: &TickRecord) -> io::Result<()> {
        let answer = &record.answer;
        let sent_ns = if record.overtaken { record.received_ns } else { answer.published_ns };
        let times = self.times(sent_ns, sent_ns, answer.answers);
        let mode = if record.overtaken { "overtaken" } else { mode(answer.source) };
        self.bag.write_to("/rcwm/mode", Schema::Text, times, &text(mode))?;
        if let (Some(robot), false) = (&self.robot, record.overtaken) {
            robot.sent(&mut self.bag, times, &answer.action)?;
        }
        for call in &record.calls {
            match &call.outcome {
                LoggedOutcome::Decided { surprise: Some(surprise), .. } => self.surprise(times, *surprise)?,
                LoggedOutcome::Failed(how) => {
                    self.event(sent_ns, Level::Error, &format!("the policy failed: {how}"))?;
                }
                _ => {}
            }
        }
        for (stage, time_ns) in stage_times(record) {
            let topic = format!("/rcwm/latency_us/{}", stage.as_str());
            self.number(&topic, times, (time_ns as f64 / 1e3) as f32)?;
        }
        Ok(())
    }

    fn surprise(&mut self, times: Times, surprise: Surprise) -> io::Result<()> {
        match surprise {
            Surprise::Rcwm { robot, environment } => {
                self.number("/rcwm/surprise/robot", times, robot)?;
                self.number("/rcwm/surprise/environment", times, environment)
            }
            Surprise::Dreamer(dynamics) => self.number("/rcwm/surprise/dynamics", times, dynamics),
        }
    }

    fn number(&mut self, topic: &str, times: Times, value: f32) -> io::Result<()> {
        self.bag.write_to(topic, Schema::Numbers, times, &numbers("", &[value]))
    }

    fn event(&mut self, time_ns: u64, level: Level, said: &str) -> io::Result<()> {
        let times = self.times(time_ns, time_ns, 0);
        self.bag.write_to("/rcwm/events", Schema::Event, times, &event(times.log_ns, level, said))
    }

    fn times(&self, log_ns: u64, publish_ns: u64, sequence: u64) -> Times {
        // MCAP has room for its last 32 bits.
        let sequence = sequence as u32;
        Times { log_ns: self.unix_ns(log_ns), publish_ns: self.unix_ns(publish_ns), sequence }
    }

    fn unix_ns(&self, monotonic_ns: u64) -> u64 {
        let time_ns = i128::from(monotonic_ns) + self.to_unix_ns.unwrap_or(0);
        u64::try_from(time_ns.max(0)).unwrap_or(u64::MAX)
    }
}
