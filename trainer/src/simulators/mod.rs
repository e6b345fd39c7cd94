//! Simulators as processes: started and stopped here, or joined where they already run; and `collect`, which records their episodes.

/// Visual disturbances that the simulator knows, by strength; `varied` is for learning (`rcwm-simulator serve --help`).
pub const DISTURBANCES: [&str; 8] =
    ["none", "paper", "surfaces", "light", "camera", "textures", "noise", "varied"];
/// The set of layouts to learn from.
pub const LEARNING: &str = "learning";
/// The set of layouts that is reported.
pub const REPORTING: &str = "reporting";
/// Sets of layouts. No two share one, whatever seeds and numbers of episodes are given.
pub const LAYOUTS: [&str; 3] = [LEARNING, "choosing", REPORTING];

mod client;
mod collect;
mod collect_error;
mod plan;
mod process;
mod recorder;

pub use client::{Client, ClientError, mismatches_to_act, mismatches_to_record};
pub use collect::{CollectSettings, Collected, Progress, Sums, collect, collect_disturbed, record};
pub use collect_error::CollectError;
pub use plan::{Amounts, Job, Plan, Script};
pub use process::{Launch, ProcessError, RunningProgram, SimulatorProcess};
