//! What rcwm-lab does for this program: this one draws nothing.

use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode, Output};
use std::time::Duration;

use anyhow::Context;
use rcwm_models::errors::one_line;
use rcwm_models::programs::{MissingProgram, Program};

/// Verbs that this program passes on.
const VERBS: [&str; 9] =
    ["inspect", "bundle", "bench", "replay", "telemetry", "film", "export-mcap", "watch", "plot"];

/// Runs rcwm-lab in this program's place where the command line names one of its verbs.
pub(super) fn pass_on() -> Option<ExitCode> {
    let mut words = std::env::args_os().skip(1);
    let verb = words.next().filter(|verb| VERBS.iter().any(|known| verb == known))?;
    // `exec` comes back only with an error.
    let failed = match command() {
        Ok(mut lab) => anyhow::Error::new(lab.arg(verb).args(words).exec()).context("starting rcwm-lab"),
        Err(missing) => missing.into(),
    };
    rcwm_models::errln!("error: {}", one_line(failed.as_ref()));
    Some(ExitCode::FAILURE)
}

fn command() -> Result<Command, MissingProgram> {
    Program::LAB.find().map(Command::new)
}

/// Makes sure before the run that what `option` asks for can be drawn after it.
pub(super) fn prepare(option: &str) -> anyhow::Result<()> {
    command().map(drop).with_context(|| format!("{option} needs rcwm-lab"))
}

/// Has rcwm-lab do something, and tells what it says.
pub(super) fn run(what: &'static str, arguments: impl FnOnce(&mut Command)) -> anyhow::Result<()> {
    let mut lab = command()?;
    arguments(&mut lab);
    let bar = indicatif::ProgressBar::new_spinner().with_message(what);
    bar.enable_steady_tick(Duration::from_millis(200));
    let output = lab.output();
    bar.finish_and_clear();
    let Output { status, stdout, stderr } = output.context("starting rcwm-lab")?;
    rcwm_models::out!("{}", String::from_utf8_lossy(&stdout));
    let said = String::from_utf8_lossy(&stderr);
    let error = said.lines().find_map(|line| line.strip_prefix("error: ")).unwrap_or("it says nothing");
    anyhow::ensure!(status.success(), "rcwm-lab ({status}): {error}");
    Ok(())
}
