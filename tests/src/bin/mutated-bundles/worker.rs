//! A child: works on one case after another, as the runtime would.

use std::io::{BufRead, Write};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use rcwm_models::bundle::Bundle;
use rcwm_models::errors::one_line;
use rcwm_runtime::policy::{Inputs, Sampling};
use rcwm_runtime::{Decision, EngineSettings, Policy};
use rustix::process::{Resource, Rlimit, setrlimit};
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use crate::Arguments;
use crate::bundle::{self, Original};
use crate::case::Case;

/// Largest error of an output that counts as verified, as the runtime's own.
const TOLERANCE: f32 = 1e-5;

/// Panics so far, those that the runtime has caught included.
static PANICS: AtomicU64 = AtomicU64::new(0);

/// What became of a case.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Outcome {
    /// What was done.
    pub(crate) what: String,
    /// How far it came: `open`, `inspect`, `load`, `tick`, `verify` refused it, or it was `accepted`; `invalid action` is a finding.
    pub(crate) ended: String,
    /// The line a user would see.
    pub(crate) said: String,
    /// Panics that were caught on the way.
    pub(crate) caught_panics: u64,
    /// Processor time, in s.
    pub(crate) cpu_s: f64,
    /// Time, in s.
    pub(crate) wall_s: f64,
    /// Largest resident memory of the process while it worked on it, in MiB.
    pub(crate) resident_mib_max: f64,
}

/// Reads seeds, one a line, and answers each with an [`Outcome`] as a line of JSON.
pub(crate) fn serve(arguments: &Arguments) -> anyhow::Result<()> {
    let limit = Some(arguments.memory_mib << 20);
    setrlimit(Resource::Data, Rlimit { current: limit, maximum: limit }).context("limiting memory")?;
    let default = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        PANICS.fetch_add(1, Ordering::Relaxed);
        default(info);
    }));
    let original = Original::read(&arguments.bundle)?;
    let temporary = tempfile::tempdir()?;
    let folder = arguments.keep.as_deref().unwrap_or(temporary.path());
    std::fs::create_dir_all(folder)?;
    bundle::write(folder, &original.files)?;
    for line in std::io::stdin().lock().lines() {
        let seed = line?.trim().parse().context("a seed")?;
        let case = Case::of(seed, &original);
        bundle::write(folder, &case.files)?;
        let outcome = observed(&case, folder);
        if arguments.keep.is_none() {
            let sound = case.files.keys().map(|name| (name.clone(), original.files[name].clone()));
            bundle::write(folder, &sound.collect())?;
        }
        let mut out = std::io::stdout().lock();
        writeln!(out, "{}", serde_json::to_string(&outcome)?)?;
        out.flush()?;
    }
    Ok(())
}

fn observed(case: &Case, folder: &Path) -> Outcome {
    // From here on the kernel counts the largest resident size anew.
    let fresh = std::fs::write("/proc/self/clear_refs", "5").is_ok();
    let (panics, wall, cpu) = (PANICS.load(Ordering::Relaxed), Instant::now(), cpu_time());
    let (ended, said) = use_as_the_runtime_does(folder);
    Outcome {
        what: case.what.clone(),
        ended: ended.to_owned(),
        said,
        caught_panics: PANICS.load(Ordering::Relaxed) - panics,
        cpu_s: (cpu_time() - cpu).as_secs_f64(),
        wall_s: wall.elapsed().as_secs_f64(),
        // Not known is as bad as too much.
        resident_mib_max: if fresh { resident_mib_max().unwrap_or(f64::INFINITY) } else { f64::INFINITY },
    }
}

/// Everything that the runtime's verbs do with a bundle that somebody hands them.
fn use_as_the_runtime_does(folder: &Path) -> (&'static str, String) {
    let bundle = match Bundle::open(folder) {
        Ok(bundle) => bundle,
        Err(error) => return ("open", one_line(&error)),
    };
    if let Err(error) = rcwm_lab::inspect::inspect(&bundle) {
        return ("inspect", one_line(&error));
    }
    // A policy without a world model has nothing to sample.
    let samples = bundle.manifest.model.is_some();
    let sampling = if samples { Sampling::Sample { seed: 1 } } else { Sampling::Mode };
    let mut policy = match Policy::new(&bundle, EngineSettings::tract(), sampling) {
        Ok(policy) => policy,
        Err(error) => return ("load", one_line(&error)),
    };
    match ticks(&mut policy) {
        Ok(true) => {}
        Ok(false) => return ("invalid action", String::new()),
        Err(error) => return ("tick", one_line(&error)),
    }
    match rcwm_runtime::verify::verify(&bundle, EngineSettings::tract(), TOLERANCE, &mut || {}) {
        Ok(report) if report.failures.is_empty() => ("accepted", String::new()),
        Ok(report) => ("verify", report.failures.join("; ")),
        Err(error) => ("verify", one_line(&error)),
    }
}

/// Some ticks; whether every action was fit to send.
fn ticks(policy: &mut Policy) -> Result<bool, rcwm_runtime::PolicyError> {
    let image: Vec<u8> = (0..policy.image_bytes()).map(|i| ((i * 7) >> 3) as u8).collect();
    let state = vec![0.5; policy.manifest().measured_numbers()];
    let seen = Inputs { image: &image, state: &state };
    let limits = policy.limits();
    let fit = |decision: &Decision| limits.clamp(decision.action) == decision.action;
    let mut executed = None;
    for tick in 0..4 {
        let decision = match (tick, &executed) {
            (2, Some(action)) => policy.imagine(action)?,
            _ => policy.observe(seen, executed.as_ref())?,
        };
        if !fit(&decision) {
            return Ok(false);
        }
        executed = Some(decision.action);
        policy.work_ahead(executed.as_ref())?;
    }
    Ok(true)
}

fn cpu_time() -> Duration {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    // This clock never reads negative.
    Duration::new(now.tv_sec as u64, now.tv_nsec as u32)
}

fn resident_mib_max() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}
