//! Meta-World behind shared memory.
//!
//! One process runs one task: [`environment::Environment`] is the MuJoCo simulation in an embedded Python interpreter,
//! [`serve`] publishes what it sees and executes what a controller answers, in lock-step or on a fixed clock.
//!
//! ```text
//! serve --task reach --seed 0
//!   episode 0  observation 0 (FIRST) -> action -> 2 physics steps -> observation 1 ... 250 (LAST) -> answer, ignored
//!   episode 1  ...
//! ```
//!
//! An episode's layout depends on task, seed and episode number alone, so a run that was cut off can go on where it ended.

pub mod environment;
mod error;
pub mod policy;
mod python;
pub mod report;
pub mod schedule;
pub mod serve;
mod settings;
pub mod snapshot;

pub use error::SimulatorError;
