//! `rcwm-runtime run`.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use rcwm_models::wire::LinkSettings;

use super::observers::{ObserverArguments, Observers};
use super::status::StatusLine;
use crate::controller::{Controller, ControllerSettings, Ended, Fallback, TickObserver};
use crate::engine::{EngineKind, EngineSettings};
use crate::policy::{Policy, Sampling};

/// Arguments of `run`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-simulator serve --task reach --instance demo --episodes 3 &\n  \
    rcwm-runtime run --bundle models/bundles/debug --instance demo --record runs/demo\n  \
    rcwm-runtime run --bundle models/bundles/debug --instance demo --log demo.rcwmlog --telemetry demo.jsonl\n\n\
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
    #[command(flatten)]
    observers: ObserverArguments,
    /// Writes the summary to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

fn seconds(text: &str) -> Result<f64, String> {
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
    let mut observers =
        Observers::start(&arguments.observers, &arguments.instance, &bundle, &policy, engine, sampling)?;
    let mut controller = Controller::open(policy, arguments.controller_settings())?;
    let result = control(&mut controller, arguments, &mut observers, &stop);
    let mut report = controller.report(arguments.engine, *result.as_ref().unwrap_or(&Ended::Failed));
    let telemetry = controller.telemetry().clone();
    // The simulator is told before anything slow is done.
    let closed = controller.close();
    report.frames_dropped = observers.frames_dropped();
    let left = observers.finish();
    if report.counters.observations > 0 || result.is_ok() {
        print!("{}", report.summary());
        super::write_json(arguments.json.as_ref(), &report)?;
    }
    result?;
    print!("{}", left?.lines());
    print!("{}", arguments.observers.write_latencies(&telemetry, &report)?);
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
    observers: &mut Observers,
    stop: &AtomicBool,
) -> anyhow::Result<Ended> {
    let mut status = StatusLine::start(&arguments.instance).context("starting the status line")?;
    let mut all: Vec<&mut dyn TickObserver> = vec![&mut status];
    all.extend(observers.all());
    Ok(controller.run(stop, &mut all)?)
}
