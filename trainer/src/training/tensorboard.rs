//! TensorBoard's event files: records of a length, the length's checksum, an `Event` message, and its checksum.
//!
//! Only scalars are written. `metrics.jsonl` is the truth; these files are a copy for those who like to look at it there.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;

/// What every file says first; later versions than 1 tell a reader that a restart is announced.
const FILE_VERSION: &str = "brain.Event:2";
/// `SessionLog.START`.
const SESSION_START: i32 = 1;

/// `tensorboard.Event`, the fields that are used here.
#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(oneof = "What", tags = "3, 5, 7")]
    what: Option<What>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
enum What {
    #[prost(string, tag = "3")]
    FileVersion(String),
    #[prost(message, tag = "5")]
    Summary(Summary),
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    // A member of a oneof: the value 0 is written, too.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

/// An event file that is written to.
#[derive(Debug)]
pub(super) struct EventFile {
    path: PathBuf,
    file: File,
}

impl EventFile {
    /// Begins a new file in `folder`. What older files hold of `first_step` and later belongs to updates that were lost;
    /// TensorBoard then drops it.
    ///
    /// # Errors
    /// Those of making and writing it.
    pub(super) fn begin(folder: &Path, first_step: u64) -> io::Result<Self> {
        let now = since_1970();
        // Readers take the files in the order of their names.
        let name = format!(
            "events.out.tfevents.{:010}.{:09}.{}",
            now.as_secs(),
            now.subsec_nanos(),
            std::process::id()
        );
        let path = folder.join(name);
        let file = OpenOptions::new().append(true).create_new(true).open(&path)?;
        let mut events = Self { path, file };
        events.append(0, What::FileVersion(FILE_VERSION.to_owned()))?;
        if first_step > 0 {
            events.append(first_step, What::SessionLog(SessionLog { status: SESSION_START }))?;
        }
        Ok(events)
    }

    /// Where it is.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Appends scalars of one step.
    pub(super) fn scalars(&mut self, step: u64, scalars: &[(String, f64)]) -> io::Result<()> {
        let value =
            |(tag, value): &(String, f64)| Value { tag: tag.clone(), simple_value: Some(*value as f32) };
        self.append(step, What::Summary(Summary { value: scalars.iter().map(value).collect() }))
    }

    fn append(&mut self, step: u64, what: What) -> io::Result<()> {
        let event = Event { wall_time: since_1970().as_secs_f64(), step: step as i64, what: Some(what) };
        // In one piece: whoever reads at the same time, or a run that is killed, sees at most its last record cut off.
        self.file.write_all(&record(&event.encode_to_vec()))
    }
}

fn since_1970() -> std::time::Duration {
    // A clock before 1970 makes odd times, no more.
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

/// The frame of a `TFRecord`.
fn record(message: &[u8]) -> Vec<u8> {
    let length = (message.len() as u64).to_le_bytes();
    [&length[..], &masked_crc(&length), message, &masked_crc(message)].concat()
}

/// CRC-32C, rotated and shifted, so that the checksum of data that holds checksums stays good.
fn masked_crc(data: &[u8]) -> [u8; 4] {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CRC-32C bit by bit, from its definition.
    fn crc_by_definition(data: &[u8]) -> u32 {
        let mut crc = u32::MAX;
        for byte in data {
            crc ^= u32::from(*byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
            }
        }
        !crc
    }

    fn unmasked(stored: &[u8]) -> u32 {
        u32::from_le_bytes(stored.try_into().unwrap()).wrapping_sub(0xa282_ead8).rotate_left(15)
    }

    /// The events of a file; every checksum must be right and nothing may be left over.
    fn read(path: &Path) -> Vec<Event> {
        let bytes = std::fs::read(path).unwrap();
        let (mut events, mut rest) = (Vec::new(), bytes.as_slice());
        while !rest.is_empty() {
            let (header, tail) = rest.split_at(12);
            assert_eq!(unmasked(&header[8..]), crc_by_definition(&header[..8]));
            let length = u64::from_le_bytes(header[..8].try_into().unwrap()) as usize;
            let (message, tail) = tail.split_at(length);
            let (crc, tail) = tail.split_at(4);
            assert_eq!(unmasked(crc), crc_by_definition(message));
            events.push(Event::decode(message).unwrap());
            rest = tail;
        }
        events
    }

    #[test]
    fn what_was_written_reads_back_with_right_checksums() {
        assert_eq!(crc_by_definition(b"123456789"), 0xe306_9283, "the published check value");
        let folder = tempfile::tempdir().unwrap();
        let mut file = EventFile::begin(folder.path(), 0).unwrap();
        file.scalars(20, &[("losses/total".into(), 1.5), ("losses/reward".into(), 0.0)]).unwrap();
        file.scalars(40, &[("losses/total".into(), 0.25)]).unwrap();
        let events = read(file.path());
        assert_eq!(events[0].what, Some(What::FileVersion(FILE_VERSION.into())));
        let found: Vec<_> = events[1..]
            .iter()
            .map(|event| match &event.what {
                Some(What::Summary(summary)) => {
                    (event.step, summary.value[0].simple_value, summary.value.len())
                }
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(found, [(20, Some(1.5), 2), (40, Some(0.25), 1)]);
        assert!(events.iter().all(|event| event.wall_time > 1e9));
    }

    #[test]
    fn a_resumed_run_begins_another_file_that_says_where() {
        let folder = tempfile::tempdir().unwrap();
        let first = EventFile::begin(folder.path(), 0).unwrap();
        let second = EventFile::begin(folder.path(), 41).unwrap();
        assert!(first.path() < second.path(), "readers go by name");
        let events = read(second.path());
        assert_eq!(events[1].step, 41);
        assert_eq!(events[1].what, Some(What::SessionLog(SessionLog { status: SESSION_START })));
    }
}
