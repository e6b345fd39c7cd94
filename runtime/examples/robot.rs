//! A robot of your own on the wire: it publishes what it sees, and executes what the controller answers.
//!
//! ```text
//! rcwm-runtime run --bundle models/bundles/untrained --instance mine &
//! cargo run --release -p rcwm-runtime --example robot -- --instance mine --realtime
//! ```
//!
//! Replace `Table` by your robot, and Meta-World's interface by your `robot.toml`.

mod table;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::Parser;
use rcwm_models::wire::robot::{Robot, RobotError, ServeSettings, serve};
use rcwm_models::wire::{ActionValues, Format, LinkSettings, ObservationMut, SimulatorLink};
use table::Table;

/// A hand that slides over a table.
#[derive(Debug, Parser)]
struct Arguments {
    /// The name given to the controller
    #[arg(long)]
    instance: String,
    #[arg(long, default_value_t = 2)]
    episodes: u64,
    /// Actions an episode
    #[arg(long, default_value_t = 50)]
    steps: u32,
    /// At the interface's rate; without it the robot waits for every answer
    #[arg(long)]
    realtime: bool,
    /// Longest wait for an answer, in seconds
    #[arg(long, default_value_t = 60.0)]
    timeout_s: f64,
}

impl Robot for Table {
    fn reset(&mut self, episode: u64) -> Result<(), RobotError> {
        *self = Table::new(episode);
        Ok(())
    }

    fn observe(&mut self, observation: &mut ObservationMut<'_>) -> Result<(), RobotError> {
        observation.reward = self.reward();
        self.draw(observation.image(0));
        Ok(())
    }

    fn execute(&mut self, action: &ActionValues) -> Result<ActionValues, RobotError> {
        Ok(self.step(*action))
    }
}

fn main() -> anyhow::Result<()> {
    let Arguments { instance, episodes, steps, realtime, timeout_s } = Arguments::parse();
    let link = SimulatorLink::open(LinkSettings::new(&instance), &Format::metaworld())?;
    let settings = ServeSettings { episodes, steps, realtime, timeout: Duration::from_secs_f64(timeout_s) };
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    // After Ctrl-C the controller is told, and the robot rests.
    ctrlc::set_handler(move || asked.store(true, Ordering::Relaxed))?;
    let served = serve(&mut Table::new(0), link, &settings, &stop)?;
    println!("{}", serde_json::to_string_pretty(&served)?);
    Ok(())
}
