//! `rcwm-runtime run`.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use rcwm_models::bundle::Bundle;
use rcwm_models::wire::LinkSettings;

use super::status::StatusLine;
use crate::controller::{Controller, ControllerSettings, Ended, Fallback, TickObserver};
use crate::engine::{EngineKind, EngineSettings};
use crate::policy::{Policy, Sampling};
use crate::record::{Recorded, Recorder};
use crate::swap::{SwapSettings, Swapper};

/// Arguments of `run`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-simulator serve --task reach --instance demo --episodes 3 &\n  \
    rcwm-runtime run --bundle models/bundles/debug --instance demo --record runs/demo\n\n\
    Ends when the simulator says that it closes, after --episodes, or on Ctrl-C. A simulator that dies is waited for:\n\
    the run goes on with the next one on the instance.")]
pub(super) struct RunArguments {
    /// The bundle's folder
    #[arg(long, value_name = "DIR")]
    bundle: PathBuf,
    /// Name of the link: the simulator's --instance
    #[arg(long, value_name = "NAME")]
    instance: String,
    /// Engine that runs the parts
    #[arg(long, value_enum, default_value = "tract")]
    engine: EngineKind,
    /// Threads inside an operator (ort only)
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    threads: u16,
    /// Ends after this many whole episodes
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: Option<u64>,
    /// Waits for the next simulator when one has closed
    #[arg(long)]
    stay: bool,
    /// Longest wait for the first observation, in seconds; 0 waits for ever
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = seconds)]
    timeout: f64,
    /// Samples latents and actions instead of taking the most probable
    #[arg(long)]
    sample: bool,
    /// Seed of --sample
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    seed: u64,
    /// What is sent when the policy has nothing fit to send
    #[arg(long, value_enum, default_value = "hold")]
    fallback: Fallback,
    /// How long a wait polls before it blocks, in microseconds
    #[arg(long, value_name = "US", default_value_t = 50)]
    spin_us: u64,
    /// Records films, strips and episodes into this folder
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Records at most this many episodes
    #[arg(long, value_name = "N", default_value_t = 3)]
    record_episodes: u64,
    /// Writes the summary to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1e6).contains(&value) => Ok(value),
        _ => Err("expected seconds, 0 to 1000000".into()),
    }
}

pub(super) fn run(arguments: &RunArguments) -> anyhow::Result<()> {
    let stop = super::stop_flag()?;
    let bundle = super::open_bundle(&arguments.bundle)?;
    let engine = EngineSettings { kind: arguments.engine, threads: usize::from(arguments.threads) };
    let sampling = match arguments.sample {
        true => Sampling::Sample { seed: arguments.seed },
        false => Sampling::Mode,
    };
    let policy = Policy::new(&bundle, engine, sampling)?;
    let mut recorder = start_recorder(arguments, &bundle, engine)?;
    let mut controller = Controller::open(policy, arguments.controller_settings())?;
    // A recorder draws with the decoder of the bundle it was started with.
    if arguments.record.is_none() {
        let (link, rate_hz) = (LinkSettings::new(&arguments.instance), bundle.manifest.control.rate_hz);
        controller.take_swaps(Swapper::start(SwapSettings { link, engine, sampling, rate_hz })?);
    }
    let result = control(&mut controller, arguments, recorder.as_mut(), &stop);
    let mut report = controller.report(arguments.engine, *result.as_ref().unwrap_or(&Ended::Failed));
    // The simulator is told before anything slow is done.
    let closed = controller.close();
    report.frames_dropped = recorder.as_ref().map_or(0, Recorder::dropped);
    let recorded = finish_recorder(recorder);
    if report.counters.observations > 0 || result.is_ok() {
        print!("{}", report.summary());
        super::write_json(arguments.json.as_ref(), &report)?;
    }
    result?;
    print!("{}", recorded_lines(&recorded?));
    Ok(closed?)
}

impl RunArguments {
    fn controller_settings(&self) -> ControllerSettings {
        let spin = Duration::from_micros(self.spin_us);
        ControllerSettings {
            link: LinkSettings { spin, ..LinkSettings::new(&self.instance) },
            episodes_max: self.episodes,
            stay: self.stay,
            first_timeout: (self.timeout > 0.0).then(|| Duration::from_secs_f64(self.timeout)),
            fallback: self.fallback,
        }
    }
}

fn control(
    controller: &mut Controller,
    arguments: &RunArguments,
    recorder: Option<&mut Recorder>,
    stop: &AtomicBool,
) -> anyhow::Result<Ended> {
    let mut status = StatusLine::start(&arguments.instance).context("starting the status line")?;
    let mut observers: Vec<&mut dyn TickObserver> = vec![&mut status];
    if let Some(recorder) = recorder {
        observers.push(recorder);
    }
    Ok(controller.run(stop, &mut observers)?)
}

fn start_recorder(
    arguments: &RunArguments,
    bundle: &Bundle,
    engine: EngineSettings,
) -> anyhow::Result<Option<Recorder>> {
    let Some(folder) = &arguments.record else { return Ok(None) };
    Ok(Some(Recorder::start(folder, arguments.record_episodes, bundle, engine)?))
}

fn finish_recorder(recorder: Option<Recorder>) -> anyhow::Result<Recorded> {
    let Some(recorder) = recorder else { return Ok(Recorded::default()) };
    let bar = indicatif::ProgressBar::new_spinner().with_message("writing films and episodes");
    bar.enable_steady_tick(Duration::from_millis(200));
    let recorded = recorder.finish()?;
    bar.finish_and_clear();
    Ok(recorded)
}

fn recorded_lines(recorded: &Recorded) -> String {
    let mut text = String::new();
    for path in recorded.films.iter().chain(&recorded.episodes) {
        text += &format!("recorded   {}\n", path.display());
    }
    if recorded.broken_episodes > 0 {
        text += &format!(
            "recorded   {} episode(s) without .npz: observations of them were lost\n",
            recorded.broken_episodes
        );
    }
    text
}
