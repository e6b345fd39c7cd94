//! The writing thread.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::time::Duration;

use rcwm_models::wire::{Observation, ObservationFlags};

use super::LogError;
use super::frames::{MAGIC, write_frame, write_start};
use super::pack::{ImagePacker, PackedMask};
use super::record::{
    Header, KEYFRAME_TICKS, LoggedCall, LoggedOutcome, Observed, Record, TickRecord, WholeState, digest,
};
use super::slot::Slot;
use crate::policy::{Call, CallOutcome};

/// What was written reaches the file after so long at the latest.
const FLUSH: Duration = Duration::from_millis(500);
/// Niceness of the writing thread: Linux keeps one per thread.
const NICENESS: i32 = 10;

/// What was written.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct LogSummary {
    /// The file.
    pub file: PathBuf,
    /// Ticks in it.
    pub ticks: u64,
    /// Ticks that were dropped because the writer could not keep up.
    pub dropped: u64,
    /// Size of the file, in bytes.
    pub bytes: u64,
}

pub(super) struct Worker {
    path: PathBuf,
    to: BufWriter<File>,
    images: ImagePacker,
    ticks: u64,
    bytes: u64,
}

impl Worker {
    /// Writes the header at once, so that a file that cannot be written is found before the run.
    pub(super) fn start(path: &Path, file: File, header: &Header) -> Result<Self, LogError> {
        let mut worker = Self {
            path: path.to_path_buf(),
            to: BufWriter::with_capacity(1 << 16, file),
            images: ImagePacker::new(),
            ticks: 0,
            bytes: MAGIC.len() as u64 + 4,
        };
        let payload = serde_json::to_vec(header).map_err(|error| worker.failed(error.into()))?;
        write_start(&mut worker.to).map_err(|error| worker.failed(error))?;
        worker.frame(&payload)?;
        worker.flush()?;
        Ok(worker)
    }

    pub(super) fn run(
        mut self,
        filled: &Receiver<Box<Slot>>,
        give_back: &SyncSender<Box<Slot>>,
        dropped: &AtomicU64,
    ) -> Result<LogSummary, LogError> {
        // Packing must not take the processor from the loop; where that is not granted, it is done as fast as may be.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
        loop {
            match filled.recv_timeout(FLUSH) {
                Ok(slot) => {
                    self.tick(&slot)?;
                    // The loop may have ended; then nobody needs it back.
                    let _ = give_back.try_send(slot);
                }
                Err(RecvTimeoutError::Timeout) => self.flush()?,
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        let dropped = dropped.load(Ordering::Relaxed);
        self.record(&Record::End { ticks: self.ticks, dropped })?;
        self.flush()?;
        self.to.get_ref().sync_all().map_err(|error| self.failed(error))?;
        Ok(LogSummary { ticks: self.ticks, dropped, bytes: self.bytes, file: self.path })
    }

    fn tick(&mut self, slot: &Slot) -> Result<(), LogError> {
        if let Some(bundle) = &slot.other_bundle {
            self.record(&Record::Policy(bundle.clone()))?;
        }
        let keyframe = self.ticks.is_multiple_of(KEYFRAME_TICKS) || slot.resumes;
        let observed = slot.observed.then(|| self.observed(&slot.observation, keyframe));
        let record = TickRecord {
            dropped_before: slot.dropped_before,
            resumes: slot.resumes,
            is_first: slot.is_first,
            observed,
            scheduled_ns: slot.times.scheduled_ns,
            received_ns: slot.times.received_ns,
            overtaken: slot.overtaken,
            calls: slot.calls.iter().map(LoggedCall::from).collect(),
            answer: slot.answer.into(),
            digest: digest(&slot.state),
            state: keyframe.then(|| WholeState::of(&slot.state, slot.noise_position)),
        };
        self.record(&Record::Tick(Box::new(record)))?;
        self.ticks += 1;
        Ok(())
    }

    fn observed(&mut self, observation: &Observation, keyframe: bool) -> Observed {
        let image = self.images.pack(&observation.image, keyframe);
        let masked = observation.is(ObservationFlags::MASK_VALID);
        Observed::of(observation, image, masked.then(|| PackedMask::pack(&observation.robot_mask)))
    }

    fn record(&mut self, record: &Record) -> Result<(), LogError> {
        let payload =
            postcard::to_stdvec(record).map_err(|error| self.failed(std::io::Error::other(error)))?;
        self.frame(&payload)
    }

    fn frame(&mut self, payload: &[u8]) -> Result<(), LogError> {
        self.bytes += write_frame(&mut self.to, payload).map_err(|error| self.failed(error))?;
        Ok(())
    }

    fn flush(&mut self) -> Result<(), LogError> {
        self.to.flush().map_err(|error| self.failed(error))
    }

    fn failed(&self, source: std::io::Error) -> LogError {
        LogError::Io { path: self.path.clone(), source }
    }
}

impl From<&Call> for LoggedCall {
    fn from(call: &Call) -> Self {
        Self { kind: call.kind, action: call.action, outcome: call.outcome.into() }
    }
}

impl From<CallOutcome> for LoggedOutcome {
    fn from(outcome: CallOutcome) -> Self {
        match outcome {
            CallOutcome::Done { time_ns } => Self::Done(time_ns),
            CallOutcome::StateSet { checksum } => Self::StateSet(checksum),
            CallOutcome::Decided { action, recomputed, surprise, stage_ns } => {
                Self::Decided { action, recomputed, surprise, stage_ns: stage_ns.to_vec() }
            }
            CallOutcome::NotFinite { part } => Self::Failed(format!("{part} not finite")),
            CallOutcome::Refused => Self::Failed("refused".into()),
            CallOutcome::EngineFailed => Self::Failed("engine failed".into()),
        }
    }
}
