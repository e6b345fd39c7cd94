//! The log of a run: every tick's inputs, what the policy was asked and gave, the state after it, and the times, so that a replay
//! makes the same calls again and compares bit for bit.
//!
//! **File.** The magic bytes `rcwm-log`, a version (u32), then frames: length (u32), CRC-32C of the payload (u32), payload. All
//! numbers are little-endian. The first payload is the [`Header`] as JSON, every other one a [`Record`] in postcard's encoding, the
//! last one [`Record::End`]. Pictures are packed without loss: the difference to the last one, in LZ4.
//!
//! **Writing.** [`LogWriter`] is a sink of [`crate::record`]: packing and writing happen in the writer's thread. Ticks that were dropped
//! are marked in the next record.
//!
//! **Damage.** A log that was cut or changed is read up to the damage, which is one clear error.
//!
//! **Where a replay may start.** Every record holds a digest of the state; the first one, one of every [`KEYFRAME_TICKS`], and each one
//! after dropped ticks holds the whole state and the place of the random generator.

pub mod frames;
mod header;
pub mod pack;
mod reader;
mod record;
mod writer;

pub use header::{BundleIdentity, Header, Machine};
pub use reader::{Entry, LogReader, LoggedTick};
pub use record::{
    Answer, DIGEST_BYTES, KEYFRAME_TICKS, LoggedCall, LoggedOutcome, Observed, Record, TickRecord,
    WholeState, digest,
};
pub use writer::{LogSettings, LogSummary, LogWriter};

use std::path::PathBuf;

/// Why a log could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file could not be opened, read or written.
    #[error("log {path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    /// A log is never written over.
    #[error("log {path} exists already; name another file, or remove it")]
    Exists { path: PathBuf },
    /// It is no log.
    #[error("{path} is no log: {reason}; expected a file written by `rcwm-runtime run --log`")]
    NotALog {
        path: PathBuf,
        /// What was found.
        reason: String,
    },
    /// It is the log of another version.
    #[error(
        "log {path} has version {found}, this program reads version {expected}; use the program that wrote it"
    )]
    Version {
        path: PathBuf,
        /// Its version.
        found: u32,
        expected: u32,
    },
    /// It was cut or changed.
    #[error(
        "log {path} is damaged at byte {offset}: {reason}; the {ticks} ticks before it are sound, for those after it \
         log the run again"
    )]
    Damaged {
        path: PathBuf,
        /// Where the broken frame begins.
        offset: u64,
        reason: String,
        /// Ticks read before it.
        ticks: u64,
    },
}
