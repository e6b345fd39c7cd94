//! Writing a log: a sink of the loop's records.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{Format, Observation};

use super::LogError;
use super::frames::{MAGIC, write_frame, write_start};
use super::header::{BundleIdentity, Header, Machine};
use super::pack::{ImagePacker, PackedMask};
use super::record::{
    KEYFRAME_TICKS, LoggedCall, LoggedOutcome, Observed, Record, TickRecord, WholeState, digest,
};
use crate::controller::Fallback;
use crate::engine::EngineSettings;
use crate::policy::{Call, CallOutcome, Policy, STAGES, Sampling};
use crate::record::{self, Sink};

/// What was written reaches the file after so long at the latest.
const FLUSH: Duration = Duration::from_millis(500);

/// What a log says about its run.
#[derive(Debug, Clone)]
pub struct LogSettings {
    /// The link's instance.
    pub instance: String,
    pub engine: EngineSettings,
    /// How latents and actions are chosen.
    pub sampling: Sampling,
    /// What is sent where the policy has nothing valid to send.
    pub fallback: Fallback,
    /// Largest change of an action's component from one action to the next.
    pub rate_max: Option<f32>,
    /// Ends with so many episodes; none logs the whole run.
    pub episodes_max: Option<u64>,
}

impl LogSettings {
    /// Of a controller with the usual settings: the interface's fallback, and no limit of rate beside the interface's.
    #[must_use]
    pub fn new(instance: &str, engine: EngineSettings, sampling: Sampling) -> Self {
        let (fallback, rate_max) = (Fallback::Interface, None);
        Self { instance: instance.to_owned(), engine, sampling, fallback, rate_max, episodes_max: None }
    }
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct LogSummary {
    pub file: PathBuf,
    pub ticks: u64,
    /// Ticks that were dropped because the writer could not keep up.
    pub dropped: u64,
    /// Size of the file, in bytes.
    pub bytes: u64,
    /// Folders of the bundles that ran.
    pub bundles: Vec<PathBuf>,
}

/// Writes a log.
pub struct LogWriter {
    path: PathBuf,
    to: BufWriter<File>,
    flushed: Instant,
    /// One a camera.
    images: Vec<ImagePacker>,
    /// By which interface the last observation was.
    format: Option<Arc<Format>>,
    bundles: Vec<PathBuf>,
    ticks: u64,
    bytes: u64,
    episodes_left: Option<u64>,
    over: bool,
    failed: Option<LogError>,
}

impl LogWriter {
    /// Starts a new log of a policy. The header is written at once, so that a file that cannot be written is found before the run.
    ///
    /// # Errors
    /// [`LogError::Exists`] or [`LogError::Io`].
    pub fn start(file: &Path, policy: &Policy, settings: LogSettings) -> Result<Self, LogError> {
        let opened = File::create_new(file).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => LogError::Exists { path: file.to_path_buf() },
            _ => LogError::Io { path: file.to_path_buf(), source },
        })?;
        let mut writer = Self {
            path: file.to_path_buf(),
            to: BufWriter::with_capacity(1 << 16, opened),
            flushed: Instant::now(),
            images: Vec::new(),
            format: None,
            bundles: vec![policy.folder().to_path_buf()],
            ticks: 0,
            bytes: MAGIC.len() as u64 + 4,
            episodes_left: settings.episodes_max,
            over: false,
            failed: None,
        };
        let payload =
            serde_json::to_vec(&header(policy, settings)).map_err(|error| writer.error(error.into()))?;
        write_start(&mut writer.to).map_err(|error| writer.error(error))?;
        writer.frame(&payload)?;
        writer.flush()?;
        Ok(writer)
    }

    /// Writes the end; `dropped` ticks of the run had no record.
    ///
    /// # Errors
    /// The first error there was; what had been written by then is in the file.
    pub fn finish(mut self, dropped: u64) -> Result<LogSummary, LogError> {
        if let Some(failed) = self.failed.take() {
            return Err(failed);
        }
        self.record(&Record::End { ticks: self.ticks, dropped })?;
        self.flush()?;
        self.to.get_ref().sync_all().map_err(|error| self.error(error))?;
        let Self { path: file, ticks, bytes, bundles, .. } = self;
        Ok(LogSummary { file, ticks, dropped, bytes, bundles })
    }

    /// Whether the record belongs to an episode that is still wanted.
    fn is_wanted(&mut self, record: &record::Record) -> bool {
        if record.is_first
            && let Some(left) = &mut self.episodes_left
        {
            self.over |= *left == 0;
            *left = left.saturating_sub(1);
        }
        !self.over
    }

    fn tick(&mut self, from: &record::Record) -> Result<(), LogError> {
        if let Some(policy) = &from.exchanged {
            if !self.bundles.contains(&policy.folder) {
                self.bundles.push(policy.folder.clone());
            }
            self.record(&Record::Policy(BundleIdentity::of(&policy.manifest)))?;
        }
        let keyframe = self.ticks.is_multiple_of(KEYFRAME_TICKS) || from.resumes;
        if from.observed {
            self.note_interface(&from.observation.view())?;
        }
        let observed = from.observed.then(|| self.observed(&from.observation.view(), keyframe));
        let record = TickRecord {
            dropped_before: from.dropped_before,
            resumes: from.resumes,
            is_first: from.is_first,
            observed,
            scheduled_ns: from.times.scheduled_ns,
            received_ns: from.times.received_ns,
            overtaken: from.overtaken,
            calls: from.calls.iter().map(LoggedCall::from).collect(),
            answer: from.answer.into(),
            digest: digest(&from.state),
            state: keyframe.then(|| WholeState::of(&from.state, from.noise_position)),
        };
        self.record(&Record::Tick(Box::new(record)))?;
        self.ticks += 1;
        Ok(())
    }

    fn observed(&mut self, observation: &Observation<'_>, keyframe: bool) -> Observed {
        let cameras = 0..observation.format().interface().camera.len();
        let images = self.images.iter_mut().enumerate();
        let images =
            images.map(|(camera, packer)| packer.pack(observation.image(camera), keyframe)).collect();
        let masks = cameras.map(|camera| observation.mask(camera).map(PackedMask::pack)).collect();
        Observed::of(observation, images, masks)
    }

    /// Writes by which interface the observations that follow are.
    fn note_interface(&mut self, observation: &Observation<'_>) -> Result<(), LogError> {
        if self.format.as_ref() == Some(observation.format()) {
            return Ok(());
        }
        let interface = observation.format().interface();
        self.images.clear();
        self.images.resize_with(interface.camera.len(), ImagePacker::default);
        self.format = Some(Arc::clone(observation.format()));
        self.record(&Record::Interface(interface.canonical()))
    }

    fn record(&mut self, record: &Record) -> Result<(), LogError> {
        let payload =
            postcard::to_stdvec(record).map_err(|error| self.error(std::io::Error::other(error)))?;
        self.frame(&payload)
    }

    fn frame(&mut self, payload: &[u8]) -> Result<(), LogError> {
        self.bytes += write_frame(&mut self.to, payload).map_err(|error| self.error(error))?;
        Ok(())
    }

    fn flush(&mut self) -> Result<(), LogError> {
        self.flushed = Instant::now();
        self.to.flush().map_err(|error| self.error(error))
    }

    fn error(&self, source: std::io::Error) -> LogError {
        LogError::Io { path: self.path.clone(), source }
    }
}

impl Sink for LogWriter {
    fn wants_pictures(&self) -> bool {
        true
    }

    fn take(&mut self, record: &record::Record) {
        if self.failed.is_none() && self.is_wanted(record) {
            self.failed = self.tick(record).err();
        }
    }

    fn pause(&mut self, _: u64) {
        if self.failed.is_none() && self.flushed.elapsed() >= FLUSH {
            self.failed = self.flush().err();
        }
    }
}

fn header(policy: &Policy, settings: LogSettings) -> Header {
    let since_1970 = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    Header {
        program: env!("CARGO_PKG_VERSION").to_owned(),
        started_unix_s: since_1970.as_secs(),
        monotonic_to_unix_ns: i64::try_from(since_1970.as_nanos() as i128 - i128::from(monotonic_ns())).ok(),
        instance: settings.instance,
        bundle: BundleIdentity::of(policy.manifest()),
        engine: settings.engine,
        sampling: settings.sampling,
        fallback: settings.fallback,
        rate_max: settings.rate_max,
        stages: STAGES.iter().map(ToString::to_string).collect(),
        machine: Machine::here(),
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
