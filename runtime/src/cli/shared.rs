//! What the command lines of rcwm-runtime and rcwm-lab share.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::ValueEnum;
use rcwm_models::bundle::Bundle;
use rcwm_models::files::{Output, prepare_output, write_output};
use rcwm_models::progress::Bar;
use serde::Serialize;

use crate::engine::EngineKind;

/// Exit code of a program that a second Ctrl-C ended at once.
pub const ENDED_AT_ONCE: u8 = 130;

/// One engine or all that are there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum EngineChoice {
    /// tract, compiled in.
    Tract,
    /// ONNX Runtime.
    Ort,
    /// Both, where ONNX Runtime is present.
    All,
}

impl EngineChoice {
    /// The engines to use, and why one of them is left out. An engine that was asked for by name must be there.
    pub fn engines(self) -> anyhow::Result<(Vec<EngineKind>, Option<String>)> {
        match self {
            Self::Tract => Ok((vec![EngineKind::Tract], None)),
            Self::Ort => {
                crate::engine::available(EngineKind::Ort)?;
                Ok((vec![EngineKind::Ort], None))
            }
            Self::All => match crate::engine::available(EngineKind::Ort) {
                Ok(()) => Ok((vec![EngineKind::Tract, EngineKind::Ort], None)),
                Err(error) => Ok((vec![EngineKind::Tract], Some(error.to_string()))),
            },
        }
    }
}

/// Opens and checks a bundle; what stands in its place is said.
pub fn open_bundle(folder: &Path) -> anyhow::Result<Bundle> {
    if folder.is_file() {
        anyhow::bail!(
            "{} is a file; expected the folder of a bundle, with manifest.toml; `rcwm-lab bundle` makes one of an ONNX file",
            folder.display()
        );
    }
    let checkpoint = ["", "checkpoints/last"].map(|place| folder.join(place).join("checkpoint.toml"));
    if !folder.join("manifest.toml").exists() && checkpoint.iter().any(|file| file.is_file()) {
        anyhow::bail!(
            "{} is a checkpoint of the trainer, no bundle; `rcwm-trainer export --checkpoint {0} --out BUNDLE` makes one",
            folder.display()
        );
    }
    if !folder.is_dir() {
        anyhow::bail!(
            "no bundle at {}: no such folder; `rcwm-trainer export --checkpoint DIR --out {}` makes one",
            folder.display(),
            folder.display()
        );
    }
    Bundle::open(folder).with_context(|| format!("{} is not a usable bundle", folder.display()))
}

/// Makes sure before the work that its result can be written.
pub fn prepare_json(path: Option<&Path>) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    prepare_output(path, Output::Json).context("--json")
}

/// Writes a result that was asked for as JSON.
pub fn write_json(path: Option<&Path>, report: &impl Serialize) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    let mut json = serde_json::to_vec_pretty(report).context("writing JSON")?;
    json.push(b'\n');
    write_output(path, &json).context("--json")
}

/// Signals this close together are one: supervisors and `timeout` signal a process, then its whole group.
const ONE_SIGNAL: Duration = Duration::from_millis(300);
/// Time for what is done before the process ends at once.
const LAST_DEED: Duration = Duration::from_secs(1);

/// A flag that Ctrl-C or SIGTERM sets; a second one, later, ends the process at once.
pub fn stop_flag() -> anyhow::Result<Arc<AtomicBool>> {
    stop_flag_after(|| ())
}

/// The same; before a second signal ends the process, `last` is done, for which there is a second.
pub fn stop_flag_after(last: impl Fn() + Clone + Send + 'static) -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let mut first: Option<Instant> = None;
    ctrlc::set_handler(move || {
        flag.store(true, Ordering::Relaxed);
        if first.get_or_insert_with(Instant::now).elapsed() > ONE_SIGNAL {
            let (done, is_done) = std::sync::mpsc::channel();
            let last = last.clone();
            let work = move || {
                last();
                done.send(())
            };
            // What takes longer, panics or finds no thread is not waited for.
            if std::thread::Builder::new().spawn(work).is_ok() {
                let _ = is_done.recv_timeout(LAST_DEED);
            }
            std::process::exit(i32::from(ENDED_AT_ONCE));
        }
    })
    .context("listening for Ctrl-C")?;
    Ok(stop)
}

/// A bar over `len` of `unit`; lines where there is no terminal.
pub fn progress_bar(len: usize, what: &'static str, unit: &'static str) -> Bar {
    let style = indicatif::ProgressStyle::with_template("{prefix} {wide_bar} {pos}/{len} {elapsed}")
        .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar());
    Bar::new(indicatif::ProgressBar::new(len as u64).with_style(style).with_prefix(what), what, unit)
}
