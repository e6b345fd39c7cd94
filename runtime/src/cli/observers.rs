//! What looks on while `run` goes on, and what it leaves behind: films, a log, snapshots, latencies.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use rcwm_models::bundle::Bundle;
use rcwm_models::files::free_name;

use crate::controller::{Pace, RunReport, TickObserver};
use crate::log::{LogError, LogSettings, LogSummary, Logger};
use crate::policy::Policy;
use crate::record::{Recorded, Recorder};
use crate::snapshots::{SnapshotSettings, Snapshots};
use crate::telemetry::{LatencyFiles, Telemetry};

/// What is to be written.
#[derive(Debug, Args)]
pub(super) struct ObserverArguments {
    /// Records films, strips and episodes into this folder
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Records at most this many episodes
    #[arg(long, value_name = "N", default_value_t = 3, requires = "record")]
    record_episodes: u64,
    /// Logs every tick to this file, for `rcwm-runtime replay`; where it exists, to another: FILE-2, FILE-3, ...
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

/// Everything that looks on.
pub(super) struct Observers {
    recorder: Option<Recorder>,
    logger: Option<Logger>,
    snapshots: Option<Snapshots>,
}

/// What they have left behind.
pub(super) struct Left {
    recorded: Recorded,
    log: Option<LogSummary>,
}

impl ObserverArguments {
    /// Makes sure before the run that everything can be written, and each to a file of its own.
    pub(super) fn prepare(&self, json: Option<&Path>) -> anyhow::Result<()> {
        super::prepare_json(json)?;
        self.latency_files.prepare()?;
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

    /// Whether films and episodes are asked for.
    pub(super) fn records(&self) -> bool {
        self.record.is_some()
    }
}

/// Starts a log; one that is there stays as it is, so that a run that is started again after a crash comes back.
fn start_log(file: &Path, policy: &Policy, log: &LogSettings) -> Result<Logger, LogError> {
    if file.exists() && !file.is_file() {
        let source = std::io::Error::other("a folder or a device; expected the name of a new file");
        return Err(LogError::Io { path: file.to_path_buf(), source });
    }
    loop {
        let free = free_name(file, |name| !name.exists());
        match Logger::start(&free, policy, log.clone()) {
            // Another run was faster; the next name.
            Err(LogError::Exists { .. }) => {}
            started => {
                if free != file {
                    rcwm_models::errln!("{} is kept; this run's log is {}", file.display(), free.display());
                }
                return started;
            }
        }
    }
}

impl Observers {
    pub(super) fn start(
        arguments: &ObserverArguments,
        bundle: &Bundle,
        policy: &Policy,
        log: LogSettings,
    ) -> anyhow::Result<Self> {
        let recorder = match &arguments.record {
            Some(folder) => Some(Recorder::start(folder, arguments.record_episodes, bundle, log.engine)?),
            None => None,
        };
        let logger = match &arguments.log {
            Some(file) => Some(start_log(file, policy, &log)?),
            None => None,
        };
        let every = arguments.telemetry_every;
        let snapshots =
            arguments.telemetry.clone().map(|file| Snapshots::start(SnapshotSettings { file, every }));
        Ok(Self { recorder, logger, snapshots: snapshots.transpose()? })
    }

    pub(super) fn all(&mut self) -> impl Iterator<Item = &mut dyn TickObserver> {
        fn observer<T: TickObserver>(one: &mut T) -> &mut dyn TickObserver {
            one
        }
        let Self { recorder, logger, snapshots } = self;
        let all = [
            recorder.as_mut().map(observer),
            logger.as_mut().map(observer),
            snapshots.as_mut().map(observer),
        ];
        all.into_iter().flatten()
    }

    pub(super) fn frames_dropped(&self) -> u64 {
        self.recorder.as_ref().map_or(0, Recorder::dropped)
    }

    /// Waits until everything is written. What could not be written keeps nothing else from being told.
    pub(super) fn finish(self) -> (Left, Vec<anyhow::Error>) {
        let writes = self.recorder.is_some() || self.logger.is_some() || self.snapshots.is_some();
        // Where nothing is left to write, a terminal is not waited for either.
        let bar = writes.then(|| {
            let bar = indicatif::ProgressBar::new_spinner().with_message("writing what was recorded");
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        let mut failures = Vec::new();
        let log = self.logger.and_then(|logger| note(logger.finish(), &mut failures));
        // A log of nothing would only take the name from the next run's.
        let empty = log.as_ref().filter(|log| log.ticks == 0 && log.dropped == 0);
        if let Some(LogSummary { file, .. }) = empty {
            let removed = std::fs::remove_file(file)
                .with_context(|| format!("removing the empty log {}", file.display()));
            note(removed, &mut failures);
        }
        let log = log.filter(|log| log.ticks > 0 || log.dropped > 0);
        self.snapshots.and_then(|snapshots| note(snapshots.finish(), &mut failures));
        let recorded = self.recorder.and_then(|recorder| note(recorder.finish(), &mut failures));
        bar.inspect(indicatif::ProgressBar::finish_and_clear);
        (Left { log, recorded: recorded.unwrap_or_default() }, failures)
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
    /// One line for people of each thing that was written.
    pub(super) fn lines(&self) -> String {
        let Recorded { films, episodes, broken_episodes } = &self.recorded;
        let mut text = String::new();
        for path in films.iter().chain(episodes) {
            text += &format!("recorded   {}\n", path.display());
        }
        if *broken_episodes > 0 {
            text += &format!(
                "recorded   {broken_episodes} episode(s) without .npz: observations of them were lost\n"
            );
        }
        if let Some(LogSummary { file, ticks, dropped, bytes }) = &self.log {
            let mib = *bytes as f64 / f64::from(1 << 20);
            text +=
                &format!("logged     {}: {ticks} ticks, {dropped} dropped, {mib:.1} MiB\n", file.display());
        }
        text
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
        if counters.observations == 0 {
            return Ok(String::new());
        }
        let period_us = match pace {
            Some(Pace::Realtime { rate_hz }) => Some(1e6 / rate_hz),
            _ => None,
        };
        let title = format!(
            "{preset} bundle for {bundle_task}, engine {engine}: {} observations",
            counters.observations
        );
        self.latency_files.write(telemetry, &title, period_us)?;
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
