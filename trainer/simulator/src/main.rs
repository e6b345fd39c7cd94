//! `rcwm-simulator`: Meta-World behind shared memory.

mod cli;

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::errors::one_line;
use rcwm_models::files::{Output, prepare_output, write_output};
use rcwm_models::progress::Bar;
use rcwm_models::tasks::{DOWNSTREAM, TASKS, UPSTREAM, task_id};
use rcwm_models::wire::{Format, LinkSettings, SimulatorLink};
use rcwm_simulator::environment::Environment;
use rcwm_simulator::serve::{ServeSettings, serve};
use rcwm_simulator::snapshot;
use serde::Serialize;

use cli::{Cli, Command, ServeArguments, TasksArguments};

fn main() -> ExitCode {
    let outcome = match Cli::parse().command {
        Command::Serve(arguments) => run_serve(&arguments),
        Command::Tasks(arguments) => run_tasks(&arguments),
    };
    // What standard output has lost is an error, too, but not the first to be told.
    let told = || rcwm_models::terminal::finish().context("standard output");
    match outcome.and_then(|()| told()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            rcwm_models::errln!("rcwm-simulator: {}", one_line(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn run_serve(arguments: &ServeArguments) -> Result<()> {
    task_id(&arguments.task)?;
    arguments.check()?;
    prepare_json(arguments.json.as_deref())?;
    let stop = stop_flag()?;
    if let Some(folder) = &arguments.snapshot {
        snapshot::prepare(folder, &arguments.task).context("--snapshot")?;
    }
    let mut link = LinkSettings::new(&arguments.instance);
    link.spin = Duration::from_micros(arguments.spin_us);
    // Before Meta-World is loaded: a taken place is reported at once, and a controller may connect meanwhile.
    let link = SimulatorLink::open(link, &Format::metaworld())?;
    let spinner = loading(&arguments.task);
    let environment = Environment::open(arguments.environment())?;
    spinner.finish_and_clear();
    rcwm_models::errln!("serving {} on instance {:?}; Ctrl-C ends", arguments.task, arguments.instance);

    let settings = arguments.serve();
    let bar = Bar::new(episodes_bar(&settings), "serving", "steps");
    let tally = serve(&environment, link, &settings, &stop, |episode, step| {
        bar.set_position(
            (episode - settings.first_episode) * u64::from(settings.steps_max) + u64::from(step),
        );
        if step == 0 {
            bar.set_message(format!("episode {episode}"));
        }
    })?;
    bar.finish_and_clear();
    let report = tally.report(&arguments.task, &arguments.instance, arguments.seed, arguments.first_episode);
    arguments.json.as_deref().map_or(Ok(()), |file| write_json(file, &report))?;
    rcwm_models::outln!("{report}");
    if let Some(remark) = arguments.period_ns().and_then(|period_ns| report.remark(period_ns)) {
        rcwm_models::errln!("note: {remark}");
    }
    Ok(())
}

/// Set by the first Ctrl-C, SIGTERM or SIGHUP; the second one ends the process at once.
fn stop_flag() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&stop);
    ctrlc::set_handler(move || {
        if seen.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })
    .context("installing the handler of Ctrl-C")?;
    Ok(stop)
}

fn loading(task: &str) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(format!("loading Meta-World, building {task}"));
    spinner.enable_steady_tick(Duration::from_millis(100));
    spinner
}

fn episodes_bar(settings: &ServeSettings) -> ProgressBar {
    let (bar, template) = match settings.episodes {
        Some(episodes) => (
            ProgressBar::new(episodes.saturating_mul(u64::from(settings.steps_max))),
            "{msg} [{bar:30}] {pos}/{len} steps, {per_sec}, {eta} left",
        ),
        None => (ProgressBar::new_spinner(), "{spinner} {msg}, {pos} steps, {per_sec}"),
    };
    let style = ProgressStyle::with_template(template).expect("the template is valid");
    bar.with_style(style)
}

#[derive(Serialize)]
struct TaskEntry {
    id: usize,
    name: &'static str,
    /// `upstream`, `downstream` or nothing: the paper's use of it.
    role: Option<&'static str>,
}

fn run_tasks(arguments: &TasksArguments) -> Result<()> {
    let entries: Vec<TaskEntry> =
        TASKS.iter().enumerate().map(|(id, name)| TaskEntry { id, name, role: role(name) }).collect();
    if let Some(file) = &arguments.json {
        prepare_json(Some(file))?;
        return write_json(file, &entries);
    }
    for TaskEntry { id, name, role } in &entries {
        rcwm_models::outln!("{}", format!("{id:2}  {name:26}{}", role.unwrap_or_default()).trim_end());
    }
    Ok(())
}

fn role(task: &str) -> Option<&'static str> {
    match task {
        _ if UPSTREAM.contains(&task) => Some("upstream"),
        _ if DOWNSTREAM.contains(&task) => Some("downstream"),
        _ => None,
    }
}

/// Makes sure before the work that its result can be written.
fn prepare_json(file: Option<&Path>) -> Result<()> {
    let Some(file) = file else { return Ok(()) };
    prepare_output(file, Output::Json).context("--json")
}

/// Writes JSON to a file; `-` is standard output.
fn write_json(file: &Path, value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value)?;
    write_output(file, format!("{text}\n").as_bytes()).context("--json")
}
