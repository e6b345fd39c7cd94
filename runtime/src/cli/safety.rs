//! The options of `run` for when things go wrong, and for being on time.

use std::time::Duration;

use clap::Args;
use rcwm_models::wire::LinkSettings;

use crate::controller::{ControllerSettings, Fallback, SurpriseLimits, TickLimits};
use crate::pacing::PacingSettings;
use crate::realtime::{self, Granted, Request};

/// What the controller does when things go wrong.
#[derive(Debug, Args)]
#[command(next_help_heading = "When things go wrong")]
pub(super) struct SafetyArguments {
    /// What is sent when the policy has nothing valid to send: what the robot's interface says of each number, hold (the action
    /// executed last), zero (no motion, where actions are displacements or velocities; refused where they are positions), or the
    /// numbers of an action in the interface's units
    #[arg(
        long,
        value_name = "interface|hold|zero|A,B,...",
        default_value = "interface",
        allow_hyphen_values = true,
        value_parser = |text: &str| text.parse::<Fallback>()
    )]
    fallback: Fallback,
    /// Missing observations in a row that the world model imagines before the fallback; a policy without one holds the last
    /// action for as many (real time)
    #[arg(long, value_name = "N", default_value_t = TickLimits::default().imagined_ticks_max)]
    imagined_ticks_max: u32,
    /// Fallback actions in a row; then silence where nobody is there, and the end of the run where the policy gives nothing valid
    #[arg(long, value_name = "N", default_value_t = TickLimits::default().fallback_ticks_max)]
    fallback_ticks_max: u32,
    /// An observation is missing when it is so many periods late (real time)
    #[arg(long, value_name = "PERIODS", default_value_t = PacingSettings::default().grace_periods, value_parser = periods)]
    grace: f64,
    /// An observation is stale, and dropped, when it was due so many periods ago (real time)
    #[arg(long, value_name = "PERIODS", default_value_t = PacingSettings::default().stale_periods, value_parser = periods)]
    stale_after: f64,
    /// Ends when a peer that was there is silent for so many seconds; 0 waits for ever
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = super::seconds)]
    silence_max: f64,
    /// Sends the fallback while the robot branch is more surprised than this, in nats ("my arm does not move as expected")
    #[arg(long, value_name = "NATS", value_parser = at_least_zero)]
    surprise_robot_max: Option<f32>,
    /// The same for the environment branch ("the scene has changed")
    #[arg(long, value_name = "NATS", value_parser = at_least_zero)]
    surprise_environment_max: Option<f32>,
    /// The same for a world model of one branch (bundles of kind dreamer)
    #[arg(long, value_name = "NATS", value_parser = at_least_zero)]
    surprise_dynamics_max: Option<f32>,
    /// Largest change of any number of the action from what was executed last, as a share of half of its range in the interface; beside
    /// the interface's own rate_max
    #[arg(long, value_name = "SHARE", value_parser = at_least_zero)]
    rate_limit: Option<f32>,
}

/// Being on time.
#[derive(Debug, Args)]
#[command(next_help_heading = "Being on time")]
pub(super) struct TimeArguments {
    /// How long a wait polls before and after an observation is expected (lock-step: before it blocks), in microseconds
    #[arg(long, value_name = "US", default_value_t = 50)]
    spin_us: u64,
    /// Does without computing the last tick once more before an observation is expected: spares processor time, and finds cold caches
    #[arg(long, alias = "no-rehearsal")]
    no_warm_up: bool,
    /// Asks for SCHED_FIFO and locked memory, and says what was granted; `require` ends the run where something is refused
    #[arg(long, value_name = "try|require", num_args = 0..=1, require_equals = true, default_missing_value = "try")]
    realtime: Option<Realtime>,
    /// Priority of --realtime
    #[arg(long, value_name = "1..99", default_value_t = 50, requires = "realtime", value_parser = clap::value_parser!(u8).range(1..=99))]
    realtime_priority: u8,
    /// Keeps the loop's thread on this core
    #[arg(long, value_name = "N")]
    cpu: Option<usize>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Realtime {
    Try,
    Require,
}

fn periods(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1000.0).contains(&value) => Ok(value),
        _ => Err("expected periods, 0 to 1000".into()),
    }
}

fn at_least_zero(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if (0.0..=f32::MAX).contains(&value) => Ok(value),
        _ => Err("expected a finite number, at least 0".into()),
    }
}

impl SafetyArguments {
    /// Settings of a controller on an instance.
    pub(super) fn settings(&self, instance: &str, time: &TimeArguments) -> ControllerSettings {
        let spin = Duration::from_micros(time.spin_us);
        ControllerSettings {
            silence_max: (self.silence_max > 0.0).then(|| Duration::from_secs_f64(self.silence_max)),
            pacing: PacingSettings {
                spin,
                gets_ready: !time.no_warm_up,
                grace_periods: self.grace,
                stale_periods: self.stale_after,
            },
            ticks: TickLimits {
                imagined_ticks_max: self.imagined_ticks_max,
                fallback_ticks_max: self.fallback_ticks_max,
            },
            fallback: self.fallback,
            surprise: SurpriseLimits {
                robot_max: self.surprise_robot_max,
                environment_max: self.surprise_environment_max,
                dynamics_max: self.surprise_dynamics_max,
            },
            rate_max: self.rate_limit,
            ..ControllerSettings::new(LinkSettings { spin, ..LinkSettings::new(instance) })
        }
    }
}

impl TimeArguments {
    /// Asks the system for what was asked for, for the calling thread.
    pub(super) fn ask(&self) -> anyhow::Result<Option<Granted>> {
        let priority = self.realtime.map(|_| self.realtime_priority);
        let granted = realtime::ask(Request { priority, cpu: self.cpu });
        if let Some(granted) = &granted
            && self.realtime == Some(Realtime::Require)
            && !granted.all()
        {
            let lines: Vec<_> = granted.lines().collect();
            anyhow::bail!("--realtime=require: {}", lines.join("; "));
        }
        Ok(granted)
    }
}
