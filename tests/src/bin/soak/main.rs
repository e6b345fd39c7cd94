//! Runs the controller for hours as it is deployed and watches its memory.
//!
//! A robot with recorded images on a fixed clock, `rcwm-runtime run` with log and telemetry, and a swap every so often, at once and at an
//! episode's start in turn: real processes on a real link. Meanwhile the run's resident memory, threads and open files are sampled. The
//! report has a row for each tenth of the time; **drift** is the median of the last tenth against that of the second one. The first is
//! the warm-up, with some swaps in quick succession: what a swap frees the allocator keeps for the next one, and it takes about ten of
//! them until no piece that is needed is missing.

mod report;
mod samples;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Parser;
use rcwm_models::bundle::Bundle;
use rcwm_models::wire::{Format, LinkSettings, SimulatorLink, forget_prefix, list_leftovers};
use rcwm_runtime::swap::{Answer, When, ask};
use rcwm_tests::campaign;
use rcwm_tests::stream::Stream;

use report::{Report, TENTHS};
use samples::Sample;

/// How often the clock is looked at.
const LOOK: Duration = Duration::from_millis(100);
/// Time between two reports on the way.
const REPORT: Duration = Duration::from_secs(60);

/// Runs the controller for hours as it is deployed and watches its memory.
#[derive(Debug, Parser)]
#[command(
    name = "soak",
    after_help = "Examples:\n  \
    soak --minutes 120 --json soak.json\n  \
    soak --minutes 10 --swap-every-s 60 --warm-up-swaps 10 --bundle models/bundles/hammer --other models/bundles/reach -- --realtime\n\n\
    What follows -- goes to `rcwm-runtime run`. Ctrl-C ends it early, with the report. Exits 0 if every swap was taken, memory's drift\n\
    is below --drift-max-mib, and nothing was left in shared memory."
)]
struct Arguments {
    /// Length, in minutes
    #[arg(long, value_name = "N", default_value_t = 120.0, value_parser = positive)]
    minutes: f64,
    /// The bundle the run starts with
    #[arg(long, value_name = "DIR", default_value = "models/bundles/hammer")]
    bundle: PathBuf,
    /// The bundle it is exchanged with, in turn; the same one where none is given
    #[arg(long, value_name = "DIR")]
    other: Option<PathBuf>,
    /// Time between two swaps, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 600.0, value_parser = positive)]
    swap_every_s: f64,
    /// Swaps in the first tenth of the time, which is the warm-up
    #[arg(long, value_name = "N", default_value_t = 16)]
    warm_up_swaps: u32,
    /// Time between two looks at the run's memory, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0, value_parser = positive)]
    sample_every_s: f64,
    /// Observations a second
    #[arg(long, value_name = "HZ", default_value_t = 40.0)]
    rate_hz: f64,
    /// Observations of an episode
    #[arg(long, value_name = "N", default_value_t = 250, value_parser = clap::value_parser!(u32).range(2..))]
    episode: u32,
    /// Drift that is borne, in MiB
    #[arg(long, value_name = "MIB", default_value_t = 1.0)]
    drift_max_mib: f64,
    /// Keeps log and telemetry in this folder, which must not hold any yet
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Writes the report to this file as JSON, also every minute on the way
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Further arguments of `rcwm-runtime run`
    #[arg(last = true)]
    run: Vec<String>,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e6 => Ok(value),
        _ => Err("expected a number above 0, at most 1000000".into()),
    }
}

fn main() -> ExitCode {
    campaign::exit(run(&Arguments::parse()))
}

fn run(arguments: &Arguments) -> anyhow::Result<bool> {
    let stop = campaign::stop_on_ctrl_c()?;
    let prefix = format!("rcwm_soak{}_", std::process::id());
    let link = LinkSettings { prefix: Some(prefix.clone()), ..LinkSettings::new("soak") };
    let temporary = tempfile::tempdir()?;
    let folder = arguments.keep.as_deref().unwrap_or(temporary.path());
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let bundle = Bundle::open(&arguments.bundle)?;
    let peer = SimulatorLink::open(link.clone(), &Format::metaworld())?;
    let mut stream = Stream::new(&peer, &bundle, arguments.rate_hz, arguments.episode)?;
    let mut controller = Running(start_run(arguments, &link, folder)?);
    stream.wait_for_controller(&stop)?;
    let (tenth, over) = (AtomicUsize::new(0), AtomicBool::new(false));
    let report = Mutex::new(Report::new(arguments));
    let process = controller.0.id();
    let clock = Clock { arguments, report: &report, tenth: &tenth, over: &over, stop: &stop };
    let (phases, ended) = std::thread::scope(|scope| {
        let swaps = scope.spawn(|| clock.swap(&link));
        let watched = scope.spawn(|| clock.watch(process));
        let phases = stream.play(&TENTHS, &tenth, &over);
        // A stream that broke off ends the others.
        over.store(true, Ordering::Relaxed);
        let ended = [swaps.join(), watched.join()];
        (phases, ended)
    });
    peer.close()?;
    let status = controller.0.wait().context("waiting for the run")?;
    let mut report = report.into_inner().unwrap_or_else(PoisonError::into_inner);
    report.phases = phases?;
    for result in ended {
        result.map_err(|_| anyhow::anyhow!("a thread of this program panicked"))??;
    }
    anyhow::ensure!(status.success(), "the run ended with {status}");
    let summary = folder.join("run.json");
    report.finish(&std::fs::read(&summary).context("the run's summary")?)?;
    report.leftovers = list_leftovers(&prefix)?;
    forget_prefix(&prefix);
    rcwm_models::out!("{}", report.text());
    campaign::write_json(arguments.json.as_deref(), &report)?;
    Ok(report.passes())
}

/// The run, killed where it still runs when this is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It has ended already in all but a failed run.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start_run(arguments: &Arguments, link: &LinkSettings, folder: &Path) -> anyhow::Result<Child> {
    let program = std::env::current_exe().context("own program")?.with_file_name("rcwm-runtime");
    let mut command = Command::new(&program);
    command.args(["run", "--instance", &link.instance, "--bundle"]).arg(&arguments.bundle);
    command.arg("--log").arg(folder.join("run.rcwmlog"));
    command.arg("--telemetry").arg(folder.join("telemetry.jsonl")).args(["--telemetry-every", "10s"]);
    command.arg("--json").arg(folder.join("run.json")).args(&arguments.run);
    command.env("RCWM_PREFIX", link.prefix.as_deref().unwrap_or_default());
    // A line an episode: nobody reads it.
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().with_context(|| format!("{}: build it first", program.display()))
}

/// What goes on beside the stream.
struct Clock<'a> {
    arguments: &'a Arguments,
    report: &'a Mutex<Report>,
    tenth: &'a AtomicUsize,
    over: &'a AtomicBool,
    stop: &'a AtomicBool,
}

impl Clock<'_> {
    fn length(&self) -> Duration {
        Duration::from_secs_f64(self.arguments.minutes * 60.0)
    }

    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }

    fn report(&self) -> std::sync::MutexGuard<'_, Report> {
        self.report.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Looks at the run until the time is over, and says when that is.
    fn watch(&self, process: u32) -> anyhow::Result<()> {
        let start = Instant::now();
        let every = Duration::from_secs_f64(self.arguments.sample_every_s);
        let (mut next, mut next_report) = (Duration::ZERO, REPORT);
        let result = loop {
            let elapsed = start.elapsed();
            if elapsed >= self.length() || self.stop.load(Ordering::Relaxed) || self.is_over() {
                break Ok(());
            }
            let share = elapsed.as_secs_f64() / self.length().as_secs_f64();
            let tenth = ((share * TENTHS.len() as f64) as usize).min(TENTHS.len() - 1);
            self.tenth.store(tenth, Ordering::Relaxed);
            if elapsed >= next {
                match Sample::of(process, elapsed, tenth) {
                    Ok(sample) => self.report().samples.push(sample),
                    Err(error) => break Err(error),
                }
                next += every;
            }
            if elapsed >= next_report {
                let report = self.report();
                rcwm_models::outln!("{}", report.line(elapsed));
                campaign::write_json(self.arguments.json.as_deref(), &*report)?;
                next_report += REPORT;
            }
            std::thread::sleep(LOOK.min(every));
        };
        self.over.store(true, Ordering::Relaxed);
        result
    }

    /// Asks for one swap after another.
    fn swap(&self, link: &LinkSettings) -> anyhow::Result<()> {
        let start = Instant::now();
        let Arguments { bundle, other, swap_every_s, warm_up_swaps, .. } = self.arguments;
        let (warm_up, warm_up_swaps) = (self.length() / TENTHS.len() as u32, *warm_up_swaps);
        for round in 1_u32.. {
            let due = match round.checked_sub(warm_up_swaps) {
                Some(later @ 1..) => warm_up + Duration::from_secs_f64(swap_every_s * f64::from(later)),
                _ => warm_up * round / (warm_up_swaps + 1),
            };
            while start.elapsed() < due {
                if self.is_over() {
                    return Ok(());
                }
                std::thread::sleep(LOOK);
            }
            let next = other.as_ref().filter(|_| round % 2 == 1).unwrap_or(bundle);
            let when = if round % 2 == 1 { When::Now } else { When::Episode };
            // When the time is over in the middle of one, it is withdrawn.
            let answer = ask(link, next, when, None, self.over, &mut |_| {});
            match answer {
                Ok(Answer::Taken { .. }) => self.report().swaps_taken += 1,
                _ if self.is_over() => return Ok(()),
                other => self.report().swaps_wrong.push(format!("swap {round}: {other:?}")),
            }
        }
        Ok(())
    }
}
