//! Simulators as processes: started and stopped here, or joined where they already run; and `collect`, which records their episodes.

mod client;
mod collect;
mod plan;
mod process;
mod recorder;

pub use client::{Client, ClientError};
pub use collect::{CollectError, CollectSettings, Collected, Seen, Sums, collect, record};
pub use plan::{Amounts, Job, Plan, Script};
pub use process::{Launch, ProcessError, Program, RunningProgram, SimulatorProcess};
