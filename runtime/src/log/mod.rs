//! The log of a run: every tick's inputs, what the policy was asked and gave, the state after it, and the times, so that a replay
//! makes the same calls again and compares bit for bit.
//!
//! **File.** The magic bytes `rcwm-log`, a version (u32), then frames: length (u32), CRC-32C of the payload (u32), payload. All
//! numbers are little-endian. The first payload is the [`Header`] as JSON, every other one a [`Record`] in postcard's encoding, the
//! last one [`Record::End`]. Pictures are packed without loss: the difference to the last one, in LZ4.
//!
//! **Writing.** The loop copies a tick into a buffer of a fixed pool; packing and writing happen in another thread. In lock-step
//! an empty pool makes the loop wait, in real time the tick is dropped, counted, and marked in the next record.
//!
//! **Damage.** A log that was cut or changed is read up to the damage, which is one clear error.
//!
//! **Where a replay may start.** Every record holds a digest of the state; the first one, one of every [`KEYFRAME_TICKS`], and each one
//! after dropped ticks holds the whole state and the place of the random generator.

mod episodes;
mod frames;
mod latencies;
mod logger;
mod pack;
mod reader;
mod record;
mod replay;
mod report;
mod slot;
#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that fails panics")]
mod tests;
mod worker;

pub use episodes::{WrittenEpisodes, write_episodes};
pub use latencies::{LoggedLatencies, LoggedLatencyReport};
pub use logger::{LogSettings, Logger};
pub use reader::{Entry, LogReader, LoggedTick};
pub use record::{
    BundleIdentity, Header, KEYFRAME_TICKS, LoggedCall, LoggedOutcome, Machine, Record, TickRecord,
};
pub use replay::Replayer;
pub use report::{Answers, Difference, ReplayReport};
pub use worker::LogSummary;

use std::path::PathBuf;

use rcwm_models::bundle::BundleError;
use rcwm_models::episode::EpisodeError;

use crate::policy::PolicyError;

/// Why a log could not be written, read or replayed.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file could not be opened, read or written.
    #[error("log {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A log is never written over.
    #[error("log {path} exists already; name another file, or remove it")]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// It is no log.
    #[error("{path} is no log: {reason}; expected a file written by `rcwm-runtime run --log`")]
    NotALog {
        /// The file.
        path: PathBuf,
        /// What was found.
        reason: String,
    },
    /// It is the log of another version.
    #[error(
        "log {path} has version {found}, this program reads version {expected}; use the program that wrote it"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
        /// Ours.
        expected: u32,
    },
    /// It was cut or changed.
    #[error("log {path} is damaged at byte {offset}: {reason}; the {ticks} ticks before it are sound")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where the broken frame begins.
        offset: u64,
        /// What is wrong.
        reason: String,
        /// Ticks read before it.
        ticks: u64,
    },
    /// The writing thread could not be started, or has panicked.
    #[error("log: {0}")]
    Thread(String),
    /// The log was made with a bundle that is not at hand.
    #[error(
        "the log was made with another bundle than {tried}: {difference}; name that bundle with --bundle"
    )]
    OtherBundle {
        /// The folders that were tried.
        tried: String,
        /// What differs.
        difference: String,
    },
    /// A bundle was refused.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The policy could not be loaded.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// An episode could not be written.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
}
