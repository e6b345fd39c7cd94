//! What is recorded while `run` goes on, and what is made of it afterwards: films, a log, snapshots, latencies.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use rcwm_models::files::free_name;
use rcwm_models::lock::Lock;

use super::status::StatusLine;
use super::{lab, shared};
use crate::controller::{Pace, RunReport, TickObserver};
use crate::log::{LogError, LogSettings, LogSummary, LogWriter};
use crate::policy::Policy;
use crate::record::{Finished, Record, Recorder, Sink};
use crate::snapshots::{SnapshotSettings, Snapshots};
use crate::telemetry::{LatencyFiles, Telemetry};

/// Name of the log from which films are drawn, in their folder.
const LOG_FOR_FILMS: &str = "run.rcwmlog";

/// What is to be written.
#[derive(Debug, Args)]
pub(super) struct ObserverArguments {
    /// Logs into this folder, and draws films, strips and episodes from the log after the run (rcwm-lab film)
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Records at most this many episodes
    #[arg(long, value_name = "N", default_value_t = 3, requires = "record")]
    record_episodes: u64,
    /// Logs every tick to this file, for `rcwm-lab replay`; where it exists, to another: FILE-2, FILE-3, ...
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// Appends a JSON line to this file every so often: counts, latencies and surprise of the last interval and in total
    #[arg(long, value_name = "FILE")]
    telemetry: Option<PathBuf>,
    /// Time between two of these lines, as in 500ms, 1s or 2m
    #[arg(long, value_name = "TIME", default_value = "1s", requires = "telemetry", value_parser = interval)]
    telemetry_every: Duration,
    #[command(flatten)]
    latency_files: LatencyFiles,
}

/// A time from a millisecond to a day.
fn interval(text: &str) -> Result<Duration, String> {
    let end = text.find(|letter: char| letter.is_ascii_alphabetic()).unwrap_or(text.len());
    let unit_s = match &text[end..] {
        "ms" => 1e-3,
        "s" | "" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("expected a number and ms, s, m or h".into()),
    };
    match text[..end].trim().parse::<f64>().map(|number| number * unit_s) {
        Ok(value_s) if (1e-3..=86_400.0).contains(&value_s) => Ok(Duration::from_secs_f64(value_s)),
        _ => Err("expected 1ms to 24h".into()),
    }
}

impl ObserverArguments {
    /// Makes sure before the run that everything can be written, and each to a file of its own.
    pub(super) fn prepare(&self, json: Option<&Path>) -> anyhow::Result<()> {
        shared::prepare_json(json)?;
        self.latency_files.prepare()?;
        if self.record.is_some() {
            lab::prepare("--record")?;
        }
        if self.latency_files.plot.is_some() {
            lab::prepare("--plot")?;
        }
        for (option, file) in [("--log", &self.log), ("--telemetry", &self.telemetry)] {
            let folder =
                file.as_deref().and_then(Path::parent).filter(|folder| !folder.as_os_str().is_empty());
            if let Some(folder) = folder {
                std::fs::create_dir_all(folder).with_context(|| format!("{option} {}", folder.display()))?;
            }
        }
        let plot = self.latency_files.plot.as_deref();
        let files = [
            ("--json", json),
            ("--log", self.log.as_deref()),
            ("--telemetry", self.telemetry.as_deref()),
            ("--plot", plot),
        ];
        let named: Vec<_> =
            files.iter().filter_map(|(option, file)| Some((*option, file.as_ref()?))).collect();
        for (index, (option, file)) in named.iter().enumerate() {
            if let Some((other, _)) = named[..index].iter().find(|(_, other)| other == file) {
                anyhow::bail!("{other} and {option} name one file, {}; each needs its own", file.display());
            }
        }
        Ok(())
    }
}

/// Starts a log; one that is there stays as it is, so that a run that is started again after a crash comes back.
fn start_log(file: &Path, policy: &Policy, log: &LogSettings) -> Result<LogWriter, LogError> {
    if file.exists() && !file.is_file() {
        let source = std::io::Error::other("a folder or a device; expected the name of a new file");
        return Err(LogError::Io { path: file.to_path_buf(), source });
    }
    loop {
        let free = free_name(file, |name| !name.exists());
        match LogWriter::start(&free, policy, log.clone()) {
            // Another run was faster; the next name.
            Err(LogError::Exists { .. }) => {}
            started => {
                if free != file && log.episodes_max.is_none() {
                    rcwm_models::errln!("{} is kept; this run's log is {}", file.display(), free.display());
                }
                return started;
            }
        }
    }
}

/// All that is made of the records while the run goes on.
struct Sinks {
    log: Option<LogWriter>,
    snapshots: Option<Snapshots>,
    status: StatusLine,
}

impl Sink for Sinks {
    fn wants_pictures(&self) -> bool {
        self.log.is_some()
    }

    fn take(&mut self, record: &Record) {
        self.log.iter_mut().for_each(|log| log.take(record));
        self.snapshots.iter_mut().for_each(|snapshots| snapshots.take(record));
        self.status.take(record);
    }

    fn pause(&mut self, dropped: u64) {
        self.log.iter_mut().for_each(|log| log.pause(dropped));
        self.snapshots.iter_mut().for_each(|snapshots| snapshots.pause(dropped));
    }
}

/// What records a run.
pub(super) struct Recording {
    recorder: Recorder<Sinks>,
    films: Option<Films>,
}

/// Films to draw after the run.
struct Films {
    folder: PathBuf,
    episodes: u64,
    /// Nobody else records there.
    lock: Lock,
}

/// What is left of a run.
pub(super) struct Left {
    log: Option<LogSummary>,
    films: Option<Films>,
    /// What did not fit between robot and policy.
    pub(super) remarks: Vec<String>,
}

impl ObserverArguments {
    /// Opens what is written while the run goes on, and starts the thread that writes.
    pub(super) fn start(&self, policy: &Policy, log: LogSettings) -> anyhow::Result<Recording> {
        let films = self.record.as_deref().map(|folder| self.films(folder)).transpose()?;
        let status =
            StatusLine::start(&log.instance, policy.manifest()).context("starting the status line")?;
        let log = match (&self.log, &films) {
            (Some(file), _) => Some(start_log(file, policy, &log)?),
            (None, Some(films)) => {
                let log = LogSettings { episodes_max: Some(films.episodes), ..log };
                Some(start_log(&films.folder.join(LOG_FOR_FILMS), policy, &log)?)
            }
            (None, None) => None,
        };
        let every = self.telemetry_every;
        let snapshots = self.telemetry.clone().map(|file| Snapshots::start(SnapshotSettings { file, every }));
        let sinks = Sinks { log, snapshots: snapshots.transpose()?, status };
        Ok(Recording { recorder: Recorder::start(policy, sinks)?, films })
    }

    fn films(&self, folder: &Path) -> anyhow::Result<Films> {
        std::fs::create_dir_all(folder).with_context(|| format!("--record {}", folder.display()))?;
        let lock = Lock::take(folder).context("--record")?;
        Ok(Films { folder: folder.to_path_buf(), episodes: self.record_episodes, lock })
    }
}

impl Recording {
    /// What the loop shows its ticks to.
    pub(super) fn recorder(&mut self) -> &mut impl TickObserver {
        &mut self.recorder
    }

    /// Waits until everything is written. What could not be written keeps nothing else from being told.
    pub(super) fn finish(self, failures: &mut Vec<anyhow::Error>) -> Left {
        let Some(Finished { sink, dropped }) = note(self.recorder.finish(), failures) else {
            return Left { log: None, films: None, remarks: Vec::new() };
        };
        let remarks = sink.status.finish();
        let log = sink.log.and_then(|log| note(log.finish(dropped), failures));
        // A log of nothing would only take the name from the next run's.
        let (log, empty): (Vec<_>, Vec<_>) =
            log.into_iter().partition(|log| log.ticks > 0 || log.dropped > 0);
        for LogSummary { file, .. } in empty {
            let removed = std::fs::remove_file(&file)
                .with_context(|| format!("removing the empty log {}", file.display()));
            note(removed, failures);
        }
        sink.snapshots.and_then(|snapshots| note(snapshots.finish(dropped), failures));
        Left { log: log.into_iter().next(), films: self.films, remarks }
    }
}

/// The value; an error is put to the others.
pub(super) fn note<T, E: Into<anyhow::Error>>(
    result: Result<T, E>,
    failures: &mut Vec<anyhow::Error>,
) -> Option<T> {
    result.map_err(|error| failures.push(error.into())).ok()
}

impl Left {
    /// Ticks that are missing in the log.
    pub(super) fn dropped(&self) -> u64 {
        self.log.as_ref().map_or(0, |log| log.dropped)
    }

    /// One line for people of each thing that was written.
    pub(super) fn lines(&self) -> String {
        let Some(LogSummary { file, ticks, dropped, bytes, .. }) = &self.log else { return String::new() };
        let mib = *bytes as f64 / f64::from(1 << 20);
        format!("logged     {}: {ticks} ticks, {dropped} dropped, {mib:.1} MiB\n", file.display())
    }

    /// Draws the films that were asked for.
    pub(super) fn draw_films(self) -> anyhow::Result<()> {
        let (Some(log), Some(Films { folder, episodes, lock })) = (self.log, self.films) else {
            return Ok(());
        };
        // It takes the lock itself.
        drop(lock);
        let (option, episodes) = (|name: &str| OsString::from(name), OsString::from(episodes.to_string()));
        let mut words =
            vec![option("film"), option("--episodes"), episodes, option("--log"), log.file.into()];
        for bundle in log.bundles {
            words.extend([option("--bundle"), bundle.into()]);
        }
        words.extend([option("--out"), folder.into()]);
        lab::run("drawing films", |lab| _ = lab.args(&words)).with_context(|| {
            let words: Vec<_> = words.iter().map(|word| word.to_string_lossy()).collect();
            format!("the films were not drawn; `rcwm-lab {}` tries again", words.join(" "))
        })
    }
}

impl ObserverArguments {
    /// Writes and draws the latencies of a run; gives a line for people of each file.
    pub(super) fn write_latencies(
        &self,
        telemetry: &Telemetry,
        report: &RunReport,
    ) -> anyhow::Result<String> {
        let RunReport { preset, bundle_task, engine, counters, pace, .. } = report;
        let LatencyFiles { hgrm, plot } = &self.latency_files;
        if counters.observations == 0 {
            return Ok(String::new());
        }
        if let Some(folder) = hgrm {
            telemetry.write_hgrm(folder)?;
        }
        if let Some(file) = plot {
            let folder = tempfile::tempdir().context("--plot")?;
            telemetry.write_hgrm(folder.path())?;
            let observations = counters.observations;
            let title =
                format!("{preset} bundle for {bundle_task}, engine {engine}: {observations} observations");
            lab::run("drawing", |lab| {
                lab.args(["plot", "--quiet", "--title", &title, "--hgrm"])
                    .arg(folder.path())
                    .arg("--out")
                    .arg(file);
                if let Some(Pace::Realtime { rate_hz }) = pace {
                    lab.args(["--period-us", &(1e6 / rate_hz).to_string()]);
                }
            })
            .context("--plot")?;
        }
        Ok(self.latency_files.lines())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_are_understood_with_their_units() {
        let ms = |text| interval(text).map(|interval| interval.as_millis());
        assert_eq!([ms("500ms"), ms("1s"), ms("2"), ms("1.5m")], [500, 1000, 2000, 90_000].map(Ok));
        assert!(["0s", "-1s", "1 parsec", "", "25h"].into_iter().all(|text| interval(text).is_err()));
    }
}
