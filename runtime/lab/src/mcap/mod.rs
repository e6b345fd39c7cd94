//! A log as an MCAP file of ROS 2's messages, for Foxglove, rerun and `ros2 bag`. `docs/mcap.md` names the topics.
//!
//! | file | holds |
//! | --- | --- |
//! | `cdr` | how ROS 2 encodes a message |
//! | `messages` | the messages, with their definitions |
//! | `bag` | the topics, and what was written to each |
//! | `file` | how MCAP stores them |
//! | `robot` | the topics that a robot's interface makes |
//! | `ticks` | what of a tick goes to which topic |

mod bag;
mod cdr;
mod file;
mod messages;
mod robot;
mod ticks;

use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use rcwm_models::files::{FileError, NewFile};
use rcwm_runtime::log::{Entry, LogError, LogReader};
use serde::Serialize;

pub use bag::WrittenTopic;

use bag::Bag;
use ticks::Ticks;

/// Why nothing could be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The log could not be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The file could not be begun or kept.
    #[error(transparent)]
    File(#[from] FileError),
    /// Nothing could be written to it.
    #[error("{path}: {source}")]
    Write { path: PathBuf, source: io::Error },
}

/// How chunks are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Compression {
    /// LZ4 frames.
    #[default]
    Lz4,
    /// As they are.
    None,
}

impl Compression {
    /// As MCAP names it.
    fn name(self) -> &'static str {
        match self {
            Self::Lz4 => "lz4",
            Self::None => "",
        }
    }
}

/// How the wall clock of an export was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WallClock {
    /// The log says what its clock read at the start.
    Logged,
    /// The log only says in which second it was begun, which is taken for the time of its first tick.
    Estimated,
}

/// What was exported.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Exported {
    pub file: PathBuf,
    pub ticks: u64,
    pub episodes: u64,
    pub messages: u64,
    /// Pictures of cameras; masks are not counted.
    pub pictures: u64,
    /// Size of the file, in bytes.
    pub bytes: u64,
    pub wall_clock: WallClock,
    /// By topic.
    pub topics: Vec<WrittenTopic>,
    /// Whether it was stopped before the end of the log, or of the episodes that were asked for.
    pub stopped: bool,
    /// Where the log is damaged; all before it was exported.
    pub log_damage: Option<String>,
}

/// Writes the first `episodes_max` episodes of a log, or all, to a new file. `go_on` is asked after every entry with the bytes read and
/// in all.
pub fn export(
    log: &mut LogReader,
    file: &Path,
    compression: Compression,
    episodes_max: Option<u64>,
    go_on: &mut dyn FnMut((u64, u64)) -> bool,
) -> Result<Exported, ExportError> {
    let write = |source| ExportError::Write { path: file.to_path_buf(), source };
    let new = NewFile::create(file)?;
    let bag = Bag::start(BufWriter::with_capacity(1 << 18, new), compression).map_err(write)?;
    let mut ticks = Ticks::start(bag, log.header()).map_err(write)?;
    let wall_clock = log.header().monotonic_to_unix_ns.map_or(WallClock::Estimated, |_| WallClock::Logged);
    let (mut stopped, mut log_damage) = (false, None);
    loop {
        match log.read() {
            Ok(Some(Entry::Policy(policy))) => ticks.policy(&policy).map_err(write)?,
            Ok(Some(Entry::Tick(tick))) => {
                if tick.record.is_first && episodes_max.is_some_and(|max| ticks.episodes >= max) {
                    break;
                }
                ticks.tick(&tick).map_err(write)?;
            }
            Ok(None) => break,
            Err(error @ LogError::Damaged { .. }) => {
                log_damage = Some(error.to_string());
                break;
            }
            Err(error) => return Err(error.into()),
        }
        if !go_on(log.progress_bytes()) {
            stopped = true;
            break;
        }
    }
    let Ticks { bag, ticks, episodes, pictures, .. } = ticks;
    let (topics, to) = bag.finish().map_err(write)?;
    let new = to.into_inner().map_err(|error| write(error.into_error()))?;
    new.keep()?;
    let bytes = std::fs::metadata(file).map_or(0, |meta| meta.len());
    let messages = topics.iter().map(|topic| topic.messages).sum();
    let file = file.to_path_buf();
    Ok(Exported { file, ticks, episodes, messages, pictures, bytes, wall_clock, topics, stopped, log_damage })
}
