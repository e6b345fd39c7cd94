//! What the programs have in common that try many cases: they stop on Ctrl-C, share their work among threads, and end with a report.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::progress::Bar;
use serde::Serialize;

/// 0 without a finding; an error is told in one line.
#[must_use]
pub fn exit(sound: anyhow::Result<bool>) -> ExitCode {
    match sound {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            rcwm_models::errln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// A flag that Ctrl-C sets.
///
/// # Errors
/// Where the signal cannot be listened for.
pub fn stop_on_ctrl_c() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).context("listening for Ctrl-C")?;
    Ok(stop)
}

/// A bar of so much work, whose parts are called `unit`.
///
/// # Errors
/// Where `style` is no template.
pub fn bar(length: u64, style: &str, unit: &'static str) -> anyhow::Result<Bar> {
    let style = ProgressStyle::with_template(style).context("the bar's template")?;
    Ok(Bar::new(ProgressBar::new(length).with_style(style), "", unit))
}

/// Does the same on so many threads until each has ended.
///
/// # Errors
/// That of a thread, or that it panicked.
pub fn on_threads(count: u64, work: impl Fn() -> anyhow::Result<()> + Sync) -> anyhow::Result<()> {
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..count).map(|_| scope.spawn(&work)).collect();
        threads.into_iter().try_for_each(|thread| match thread.join() {
            Ok(result) => result,
            Err(_) => anyhow::bail!("a thread that works on cases panicked"),
        })
    })
}

/// Writes a report as JSON, where a file was named.
pub fn write_json(path: Option<&Path>, report: &impl Serialize) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    let mut json = serde_json::to_vec_pretty(report).context("writing the report")?;
    json.push(b'\n');
    Ok(rcwm_models::files::write_output(path, &json)?)
}
