//! A robot of your own on the wire: it publishes what it sees, and executes what the controller answers.
//!
//! ```text
//! rcwm-runtime run --bundle models/bundles/untrained --instance mine &
//! cargo run --release -p rcwm-runtime --example robot -- --instance mine --rate-hz 40
//! ```
//!
//! Replace `Table` by your robot: an upright 64 x 64 RGB picture, and four numbers in [-1, 1].

mod table;

use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Parser;
use rcwm_models::tasks::OWN_TASK;
use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{
    Action, ActionValues, Format, LinkSettings, ObservationFlags, OwnedObservation, SimulatorLink, Wait,
};
use table::Table;

/// A hand that slides over a table.
#[derive(Debug, Parser)]
struct Arguments {
    /// The name given to the controller
    #[arg(long)]
    instance: String,
    /// Episodes
    #[arg(long, default_value_t = 2)]
    episodes: u64,
    /// Observations an episode
    #[arg(long, default_value_t = 50)]
    steps: u32,
    /// Steps a second; 0 waits for every answer
    #[arg(long, default_value_t = 0.0)]
    rate_hz: f64,
    /// Longest wait for an answer, in seconds
    #[arg(long, default_value_t = 60.0)]
    timeout_s: f64,
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let link = SimulatorLink::open(LinkSettings::new(&arguments.instance), &Format::metaworld())?;
    let period_ns = if arguments.rate_hz > 0.0 { (1e9 / arguments.rate_hz) as u64 } else { 0 };
    let mut robot = Robot {
        link,
        period_ns,
        due_ns: 0,
        sequence: 0,
        held: 0,
        abandoned: false,
        timeout_s: arguments.timeout_s,
    };
    for episode in 0..arguments.episodes {
        let total_reward = robot.episode(episode, arguments.steps)?;
        println!("episode {episode}: {} observations, reward {total_reward:.2}", arguments.steps);
    }
    println!("{} observations, {} of them without an answer in time", robot.sequence, robot.held);
    Ok(robot.link.close()?)
}

struct Robot {
    link: SimulatorLink,
    /// 0 waits for every answer.
    period_ns: u64,
    /// When the next observation is due.
    due_ns: u64,
    sequence: u64,
    /// Steps on which no answer had come in time.
    held: u64,
    /// The controller has said that it leaves, and none has answered since.
    abandoned: bool,
    timeout_s: f64,
}

impl Robot {
    fn episode(&mut self, episode: u64, steps: u32) -> anyhow::Result<f64> {
        let mut table = Table::new(episode);
        let mut executed = ActionValues::zeros(4);
        let (mut total_reward, mut held) = (0.0, false);
        for step in 0..steps {
            let mut observation = OwnedObservation::zeroed(self.link.format());
            observation.sequence = self.sequence;
            (observation.episode, observation.step, observation.task) = (episode, step, OWN_TASK);
            observation.flags = ObservationFlags::default()
                .with(ObservationFlags::FIRST, step == 0)
                .with(ObservationFlags::LAST, step + 1 == steps)
                .with(ObservationFlags::ACTION_HELD, held)
                .0;
            observation.reward = if step == 0 { 0.0 } else { table.reward() };
            let mut edited = observation.edit();
            edited.executed().copy_from_slice(&executed);
            table.draw(edited.image(0));
            total_reward += f64::from(observation.reward);
            // What is no number is no answer, whoever sent it.
            let answer = self.ask(observation)?.map(|answer| answer.action);
            let answer = answer.filter(ActionValues::is_finite);
            held = answer.is_none();
            self.held += u64::from(held);
            let action = match answer {
                Some(action) => action.iter().map(|value| value.clamp(-1.0, 1.0)).collect(),
                // Nobody steers any more. The hand moves by its actions, so that it rests with zeros; an arm holds its position.
                None if self.abandoned => ActionValues::zeros(4),
                // Without an answer the last action goes on.
                None => executed,
            };
            executed = table.step(action);
        }
        Ok(total_reward)
    }

    /// Publishes an observation and waits for its answer: to the end of the period, or as long as it takes.
    fn ask(&mut self, mut observation: OwnedObservation) -> anyhow::Result<Option<Action>> {
        self.sequence += 1;
        observation.period_ns = self.period_ns;
        observation.scheduled_ns = self.due_ns.max(monotonic_ns());
        // The first of all waits for a controller: the clock starts with its answer.
        let waits = self.period_ns == 0 || observation.sequence == 0;
        self.due_ns = observation.scheduled_ns + self.period_ns;
        self.link.publish_copy(&observation)?;
        let start = Instant::now();
        let mut answer = None;
        loop {
            let left = if waits {
                Duration::from_secs_f64(self.timeout_s).saturating_sub(start.elapsed())
            } else {
                Duration::from_nanos(self.due_ns.saturating_sub(monotonic_ns()))
            };
            if left.is_zero() {
                break;
            }
            let (wait, events) = self.link.wait_action(left)?;
            self.abandoned |= events.closed;
            match (wait, events) {
                (Wait::Message(action), _) if action.answers == observation.sequence => {
                    (answer, self.abandoned) = (Some(action), false);
                }
                // A controller that has just connected has not seen it.
                (Wait::TimedOut, events) if events.hello => {
                    observation.flags |= ObservationFlags::REPEATED.0;
                    self.link.publish_copy(&observation)?;
                }
                _ => {}
            }
            if waits && answer.is_some() {
                self.due_ns = monotonic_ns() + self.period_ns;
                return Ok(answer);
            }
        }
        let silent = || format!("no answer within {} s: is a controller running?", self.timeout_s);
        if waits { answer.with_context(silent).map(Some) } else { Ok(answer) }
    }
}
