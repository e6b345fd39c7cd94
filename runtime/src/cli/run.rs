//! `rcwm-runtime run`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::Args;
use rcwm_models::bundle::Bundle;
use rcwm_models::wire::{LinkSettings, say_closed_for};

use super::observers::{ObserverArguments, note};
use super::safety::{SafetyArguments, TimeArguments};
use super::shared;
use crate::controller::{Controller, ControllerSettings, Ended};
use crate::engine::{EngineKind, EngineSettings};
use crate::log::LogSettings;
use crate::policy::{Policy, Sampling};
use crate::swap::{SwapSettings, Swapper};

/// Arguments of `run`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-simulator serve --task reach --instance demo --episodes 3 &\n  \
    rcwm-runtime run --bundle models/bundles/hammer --instance demo --record runs/demo\n  \
    rcwm-runtime run --bundle models/bundles/hammer --instance demo --log demo.rcwmlog \\\n    \
    --telemetry demo.jsonl\n  \
    rcwm-runtime run --bundle DIR --instance arm --realtime --cpu 3 --fallback zero \\\n    \
    --rate-limit 0.2 --surprise-robot-max 20\n\n\
    Ends when the simulator says that it closes, after --episodes, or on Ctrl-C. A simulator that dies is waited for:\n\
    the run goes on with the next one on the instance. docs/controller.md draws what happens when.\n\n\
    Exit codes:\n  \
    0 done (also after Ctrl-C), 1 error, 2 usage, 3 no observation within --timeout, 4 stopped: the policy gave\n  \
    nothing valid for --fallback-ticks-max ticks, 5 the peer was silent for --silence-max, 130 second Ctrl-C")]
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
    /// Threads of a tick: of tract 1 or 2 (by default 2 where there are two cores), of ort those inside an operator
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    threads: Option<u16>,
    /// Keeps the weights of layers in 16 bits: faster where memory is slow; `verify --half-weights` says what it changes (tract only)
    #[arg(long)]
    half_weights: bool,
    /// Ends after this many whole episodes
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: Option<u64>,
    /// Waits for the next simulator when one has closed
    #[arg(long)]
    stay: bool,
    /// Longest wait for the first observation, in seconds; 0 waits for ever
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = super::seconds)]
    timeout: f64,
    /// Samples latents and actions instead of taking the most probable
    #[arg(long)]
    sample: bool,
    /// Seed of --sample
    #[arg(long, value_name = "SEED", default_value_t = 0, requires = "sample")]
    seed: u64,
    #[command(flatten)]
    observers: ObserverArguments,
    /// Writes the summary to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    safety: SafetyArguments,
    #[command(flatten)]
    time: TimeArguments,
}

pub(super) fn run(arguments: &RunArguments) -> anyhow::Result<()> {
    arguments.observers.prepare(arguments.json.as_deref())?;
    let link = LinkSettings::new(&arguments.instance);
    // Before and after, the robot may be another controller's.
    let is_ours = Arc::new(AtomicBool::new(false));
    let stop = shared::stop_flag_after({
        let is_ours = Arc::clone(&is_ours);
        move || {
            if is_ours.load(Ordering::Relaxed) {
                // The loop may be stuck. Where the robot cannot be told, nobody is left to hear why.
                let _ = say_closed_for(&link);
            }
        }
    })?;
    let bundle = shared::open_bundle(&arguments.bundle)?;
    let engine = EngineSettings::chosen(arguments.engine, arguments.threads, arguments.half_weights)?;
    let sampling = match arguments.sample {
        true => Sampling::Sample { seed: arguments.seed },
        false => Sampling::Mode,
    };
    let policy = Policy::new(&bundle, engine, sampling)?;
    let settings = arguments.controller_settings();
    let log = LogSettings {
        fallback: settings.fallback,
        rate_max: settings.rate_max,
        ..LogSettings::new(&arguments.instance, engine, sampling)
    };
    let mut recording = arguments.observers.start(&policy, log)?;
    let mut controller = Controller::open(policy, settings)?;
    is_ours.store(true, Ordering::Relaxed);
    match arguments.swapper(&bundle, engine, sampling) {
        Ok(swapper) => controller.take_swaps(swapper),
        // A run without swaps is better than none.
        Err(reason) => rcwm_models::errln!("warning: this run takes no swaps: {reason}"),
    }
    // Asked for last: the other threads stay ordinary ones.
    let granted = match arguments.time.ask() {
        Ok(granted) => granted,
        Err(error) => {
            // Whatever ends the run, the robot is told before a terminal is waited for.
            controller.close()?;
            return Err(error);
        }
    };
    let result = controller.run(&stop, &mut [recording.recorder()]);
    // The robot has been told: what follows may take its time, or wait for a terminal.
    let closed = controller.close();
    let ended = result.as_ref().map_or_else(Ended::from, |ended| *ended);
    let mut report = controller.report(arguments.engine, ended);
    report.realtime = granted;
    let telemetry = controller.telemetry().clone();
    is_ours.store(false, Ordering::Relaxed);
    drop(controller);
    // How the run ended comes first: it decides the exit code.
    let mut failures = Vec::new();
    let ran = note(result, &mut failures).is_some();
    let left = recording.finish(&mut failures);
    (report.frames_dropped, report.remarks) = (left.dropped(), left.remarks.clone());
    if report.counters.observations > 0 || ran {
        note(shared::write_json(arguments.json.as_deref(), &report), &mut failures);
        rcwm_models::out!("{}", report.summary());
    }
    rcwm_models::out!("{}", left.lines());
    let written = note(arguments.observers.write_latencies(&telemetry, &report), &mut failures);
    rcwm_models::out!("{}", written.unwrap_or_default());
    note(left.draw_films(), &mut failures);
    note(closed, &mut failures);
    let mut failures = failures.into_iter();
    let first = failures.next();
    for other in failures {
        rcwm_models::errln!("error: {}", super::one_line(other.as_ref()));
    }
    first.map_or(Ok(()), Err)
}

impl RunArguments {
    fn swapper(
        &self,
        bundle: &Bundle,
        engine: EngineSettings,
        sampling: Sampling,
    ) -> Result<Swapper, String> {
        let (link, interface) = (LinkSettings::new(&self.instance), bundle.manifest.interface.clone());
        let surprise = self.controller_settings().surprise;
        Swapper::start(SwapSettings { link, engine, sampling, interface, surprise })
            .map_err(|error| error.to_string())
    }

    fn controller_settings(&self) -> ControllerSettings {
        ControllerSettings {
            episodes_max: self.episodes,
            stay: self.stay,
            first_timeout: (self.timeout > 0.0).then(|| Duration::from_secs_f64(self.timeout)),
            ..self.safety.settings(&self.instance, &self.time)
        }
    }
}
