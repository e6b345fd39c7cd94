//! Reading a log, up to its end or its first damage.

use std::fs::{File, OpenOptions};
use std::io::{BufReader, Read};
use std::ops::ControlFlow;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use std::sync::Arc;

use rcwm_models::interface::Interface;
use rcwm_models::wire::{Format, OwnedObservation};

use super::LogError;
use super::frames::{FrameReader, MAGIC, Next, read_up_to};
use super::header::{BundleIdentity, Header, check_count};
use super::pack::ImagePacker;
use super::record::{Record, TickRecord, VERSION};

/// What a log holds, one after another.
#[derive(Debug)]
pub enum Entry {
    Tick(Box<LoggedTick>),
    /// From here on another policy ran.
    Policy(BundleIdentity),
}

/// A tick with its picture.
#[derive(Debug)]
pub struct LoggedTick {
    /// Ticks before it in the log.
    pub index: u64,
    /// What was written.
    pub record: TickRecord,
    /// The observation, mask included; none where nothing came.
    pub observation: Option<OwnedObservation>,
}

/// Reads a log from its beginning.
pub struct LogReader {
    path: PathBuf,
    header: Header,
    frames: FrameReader<BufReader<File>>,
    /// One a camera.
    images: Vec<ImagePacker>,
    /// By which interface observations are read.
    format: Option<Arc<Format>>,
    ticks: u64,
    bytes: u64,
    finished: bool,
    over: bool,
}

impl LogReader {
    /// Opens a log and reads its header.
    ///
    /// # Errors
    /// [`LogError::Io`], [`LogError::NotALog`], [`LogError::Version`] or [`LogError::Damaged`].
    pub fn open(path: &Path) -> Result<Self, LogError> {
        let io = |source| LogError::Io { path: path.to_path_buf(), source };
        let no_log = |reason: String| LogError::NotALog { path: path.to_path_buf(), reason };
        // A pipe that nobody writes to is not waited for.
        let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path).map_err(io)?;
        let meta = file.metadata().map_err(io)?;
        if !meta.is_file() {
            return Err(no_log("it is a folder, a pipe or a device".into()));
        }
        let bytes = meta.len();
        let mut file = BufReader::with_capacity(1 << 16, file);
        let version = read_start(&mut file).map_err(io)?.map_err(no_log)?;
        if version != VERSION {
            return Err(LogError::Version { path: path.to_path_buf(), found: version, expected: VERSION });
        }
        let mut frames = FrameReader::new(file, MAGIC.len() as u64 + 4);
        let header: Header = match frames.read().map_err(io)? {
            Next::Payload(payload) => {
                serde_json::from_slice(payload).map_err(|error| no_log(error.to_string()))?
            }
            Next::End => return Err(no_log("it ends before its header".into())),
            Next::Damaged(reason) => return Err(no_log(format!("its header is damaged: {reason}"))),
        };
        if let Some(invalid) = header.invalid() {
            return Err(no_log(format!("its header tells of {invalid}")));
        }
        let path = path.to_path_buf();
        let (images, format) = (Vec::new(), None);
        Ok(Self { path, header, frames, images, format, ticks: 0, bytes, finished: false, over: false })
    }

    /// What the run was made with.
    #[must_use]
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Ticks read so far.
    #[must_use]
    pub fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Whether its proper end was read; a log without one was cut, or is still being written.
    #[must_use]
    pub fn finished(&self) -> bool {
        self.finished
    }

    /// Bytes read so far, and size of the file.
    #[must_use]
    pub fn progress_bytes(&self) -> (u64, u64) {
        (self.frames.offset, self.bytes)
    }

    /// The next entry; none at the end.
    ///
    /// # Errors
    /// [`LogError::Io`] or [`LogError::Damaged`]; nothing comes after an error.
    pub fn read(&mut self) -> Result<Option<Entry>, LogError> {
        if self.over {
            return Ok(None);
        }
        let read = self.read_entry();
        self.over = !matches!(read, Ok(Some(_)));
        read
    }

    fn read_entry(&mut self) -> Result<Option<Entry>, LogError> {
        loop {
            let offset = self.frames.offset;
            let next = self.frames.read();
            let next = next.map_err(|source| LogError::Io { path: self.path.clone(), source })?;
            let record = match next {
                Next::Payload(payload) => {
                    postcard::from_bytes(payload).map_err(|error| format!("not a record: {error}"))
                }
                Next::End => return Ok(None),
                Next::Damaged(reason) => Err(reason),
            };
            let taken = record.and_then(|record| self.take(record)).map_err(|reason| {
                let (path, ticks) = (self.path.clone(), self.ticks);
                LogError::Damaged { path, offset, reason, ticks }
            })?;
            if let ControlFlow::Break(entry) = taken {
                return Ok(entry);
            }
        }
    }

    /// The entry that a record is, none at the log's end; goes on where it is about those that follow.
    fn take(&mut self, record: Record) -> Result<ControlFlow<Option<Entry>>, String> {
        let numbers = self.header.bundle.action_numbers();
        let entry = match record {
            Record::Tick(record) => {
                // Everything that is made of a log takes actions for those of one robot.
                record.check_counts(numbers)?;
                let observation = self.observation(&record)?;
                let index = self.ticks;
                self.ticks += 1;
                Entry::Tick(Box::new(LoggedTick { index, record: *record, observation }))
            }
            Record::Interface(text) => {
                let interface = Interface::parse(&text).map_err(|error| error.to_string())?;
                check_count("an interface with actions", interface.action_numbers(), numbers)?;
                self.images.clear();
                self.images.resize_with(interface.camera.len(), ImagePacker::default);
                self.format = Some(Format::of(interface));
                return Ok(ControlFlow::Continue(()));
            }
            Record::Policy(identity) => {
                check_count("a policy with actions", identity.action_numbers(), numbers)?;
                Entry::Policy(identity)
            }
            Record::End { .. } => {
                self.finished = true;
                return Ok(ControlFlow::Break(None));
            }
        };
        Ok(ControlFlow::Break(Some(entry)))
    }

    fn observation(&mut self, record: &TickRecord) -> Result<Option<OwnedObservation>, String> {
        let Some(observed) = &record.observed else { return Ok(None) };
        let format = self.format.as_ref().ok_or("an observation before its interface")?;
        let mut observation = observed.without_pictures(format)?;
        let (cameras, found) = (self.images.len(), (observed.images.len(), observed.masks.len()));
        if found != (cameras, cameras) {
            return Err(format!("{found:?} pictures and masks, the interface has {cameras} cameras"));
        }
        let mut edited = observation.edit();
        for (camera, packer) in self.images.iter_mut().enumerate() {
            packer.unpack(&observed.images[camera], edited.image(camera))?;
            if let Some(mask) = &observed.masks[camera] {
                mask.unpack(edited.mask(camera).ok_or("a mask that the interface does not have")?)?;
            }
        }
        Ok(Some(observation))
    }
}

/// The version, or what there is instead of a log.
fn read_start(file: &mut impl Read) -> std::io::Result<Result<u32, String>> {
    let mut start = [0; MAGIC.len() + 4];
    let found = read_up_to(file, &mut start)?;
    let (magic, version) = start.split_at(MAGIC.len());
    if found < start.len() || magic != MAGIC {
        return Ok(Err("it does not begin with the bytes \"rcwm-log\"".into()));
    }
    Ok(Ok(version.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte))))
}
