//! The command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use rcwm_simulator::environment::{Disturbance, EnvironmentSettings, Layouts, STEPS_MAX};
use rcwm_simulator::policy::Policy;
use rcwm_simulator::serve::{Pace, ServeSettings};

/// Meta-World behind shared memory: publishes what the camera sees, executes what a controller answers.
#[derive(Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The verbs.
#[derive(Subcommand)]
pub enum Command {
    /// Runs a task for a controller on this machine.
    #[command(after_help = SERVE_EXAMPLES)]
    Serve(ServeArguments),
    /// Lists all tasks, and the paper's use of them.
    #[command(after_help = TASKS_EXAMPLES)]
    Tasks(TasksArguments),
}

const SERVE_EXAMPLES: &str = "\
Examples:
  rcwm-simulator serve --task reach --episodes 3
      three episodes in lock-step with whatever controller connects to instance `rcwm`
  rcwm-simulator serve --task hammer --instance arm1 --pace realtime --rate-hz 40
      a fixed clock; the last action is held when no answer has come in time, for a second at most and not at all after
      the controller has said that it leaves: then the hand rests
  rcwm-simulator serve --task door-open --policy mixed --masks --episodes 16
      expert data with noise and robot masks for a recorder, which acknowledges each observation
  rcwm-simulator serve --task hammer --policy expert --free-run --masks --episodes 1 \\
      --snapshot pictures
      pictures of one episode, without waiting for anybody";

const TASKS_EXAMPLES: &str = "\
Examples:
  rcwm-simulator tasks
  rcwm-simulator tasks --json -";

/// How time passes.
#[derive(Clone, Copy, ValueEnum)]
pub enum PaceName {
    /// Each observation waits for its answer.
    Lockstep,
    /// A fixed clock.
    Realtime,
}

/// Arguments of `serve`.
#[derive(Args)]
pub struct ServeArguments {
    /// Name of the task; `rcwm-simulator tasks` lists them.
    #[arg(long)]
    pub task: String,
    /// Name of the shared-memory link; a controller connects to the same.
    #[arg(long, default_value = "rcwm")]
    pub instance: String,
    /// Which set of layouts; no two sets share one, whatever the seeds.
    #[arg(long, value_enum, default_value_t = Layouts::Learning)]
    pub layouts: Layouts,
    /// Layouts, scripted decisions and disturbances of a set depend on this and the episode's number.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// How many episodes; 0: until stopped.
    #[arg(long, default_value_t = 0)]
    pub episodes: u64,
    /// Number of the first episode, to go on with a run that was cut off.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub first_episode: u64,
    /// Decisions in an episode; each is executed for two physics steps.
    #[arg(long, default_value_t = STEPS_MAX, value_name = "N",
          value_parser = clap::value_parser!(u32).range(1..=i64::from(STEPS_MAX)))]
    pub steps_max: u32,
    /// How time passes.
    #[arg(long, value_enum, default_value_t = PaceName::Lockstep)]
    pub pace: PaceName,
    /// Observations a second, in real time [default: 40].
    #[arg(long, value_name = "HZ", value_parser = rate)]
    pub rate_hz: Option<f64>,
    /// Who decides. The scripted ones still wait for an answer to each observation in lock-step, as a receipt.
    #[arg(long, value_enum, default_value_t = Policy::Remote)]
    pub policy: Policy,
    /// Wait for nobody: as fast as it goes, observations may be lost. For scripted policies.
    #[arg(long)]
    pub free_run: bool,
    /// Render the robot's mask as well.
    #[arg(long)]
    pub masks: bool,
    /// Visual disturbance, drawn anew for each episode (`paper` is fixed).
    #[arg(long, value_enum, default_value_t = Disturbance::None)]
    pub disturb: Disturbance,
    /// Meta-World's own picture with shadows, reflections and full meshes; several times slower.
    #[arg(long)]
    pub faithful: bool,
    /// Give up after so many seconds without an answer (in real time: before the first one); 0: never.
    #[arg(long, default_value_t = 0, value_name = "SECONDS")]
    pub wait_controller: u64,
    /// How long a wait polls before it blocks, in microseconds.
    #[arg(long, default_value_t = 50, value_name = "US")]
    pub spin_us: u64,
    /// Write pictures of the first episode into this folder, every 50 steps, the mask beside.
    #[arg(long, value_name = "DIR")]
    pub snapshot: Option<PathBuf>,
    /// Write the summary as JSON; `-` is standard output.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Arguments of `tasks`.
#[derive(Args)]
pub struct TasksArguments {
    /// Write the list as JSON instead; `-` is standard output.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// The rate in real time unless told otherwise: that of the policies that we ship.
const RATE_HZ: f64 = 40.0;

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if (1.0..=1000.0).contains(&rate) => Ok(rate),
        _ => Err("expected 1 to 1000 observations a second".to_owned()),
    }
}

impl ServeArguments {
    /// Refuses combinations that make no sense together.
    pub fn check(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            !self.free_run || self.policy.is_scripted(),
            "--free-run waits for no controller: choose --policy expert, random or mixed"
        );
        anyhow::ensure!(
            !self.free_run || matches!(self.pace, PaceName::Lockstep),
            "--free-run has no clock: leave out --pace realtime"
        );
        anyhow::ensure!(
            self.rate_hz.is_none() || matches!(self.pace, PaceName::Realtime),
            "--rate-hz is of a clock, and lock-step has none: add --pace realtime"
        );
        anyhow::ensure!(
            !self.free_run || self.wait_controller == 0,
            "--free-run waits for no controller: leave out --wait-controller"
        );
        Ok(())
    }

    /// Time between two observations, in real time.
    pub fn period_ns(&self) -> Option<u64> {
        let period_ns = (1e9 / self.rate_hz.unwrap_or(RATE_HZ)).round() as u64;
        matches!(self.pace, PaceName::Realtime).then_some(period_ns)
    }

    /// What to simulate.
    pub fn environment(&self) -> EnvironmentSettings {
        EnvironmentSettings {
            task: self.task.clone(),
            layouts: self.layouts,
            seed: self.seed,
            faithful: self.faithful,
            masks: self.masks,
            disturb: self.disturb,
        }
    }

    /// How to serve it.
    pub fn serve(&self) -> ServeSettings {
        let pace = match self.period_ns() {
            Some(period_ns) => Pace::RealTime { period_ns },
            None if self.free_run => Pace::Free,
            None => Pace::LockStep,
        };
        ServeSettings {
            instance: self.instance.clone(),
            first_episode: self.first_episode,
            episodes: (self.episodes > 0).then_some(self.episodes),
            steps_max: self.steps_max,
            pace,
            policy: self.policy,
            silence_max: (self.wait_controller > 0).then(|| Duration::from_secs(self.wait_controller)),
            snapshots: self.snapshot.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn every_example_is_understood_and_names_files_that_are_shipped() {
        let command = Cli::command();
        let all = std::iter::once(command.clone()).chain(command.get_subcommands().cloned());
        let texts: Vec<_> = all.map(|mut verb| verb.render_long_help().ansi().to_string()).collect();
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let parse =
            |example: &[String]| Cli::try_parse_from(example).map(drop).map_err(|error| error.to_string());
        let count = rcwm_models::help::check_examples(&texts, "rcwm-simulator", &root, parse).unwrap();
        assert!(count > 4, "only {count} examples");
    }

    #[test]
    fn options_that_would_be_ignored_are_refused() {
        let check = |line: &str| {
            let words = std::iter::once("program").chain(line.split_whitespace());
            let Ok(Cli { command: Command::Serve(arguments) }) = Cli::try_parse_from(words) else {
                panic!("{line}")
            };
            arguments.check()
        };
        assert!(check("serve --task reach --rate-hz 20").is_err());
        assert!(check("serve --task reach --policy expert --free-run --wait-controller 3").is_err());
        check("serve --task reach --pace realtime --rate-hz 20").unwrap();
    }
}
