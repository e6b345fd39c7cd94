//! `rcwm-runtime swap`.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use rcwm_models::wire::LinkSettings;
use serde::Serialize;

use super::shared;
use crate::swap::{Answer, When, ask};

/// Arguments of `swap`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-runtime swap --instance demo --bundle bundles/next\n  \
    rcwm-runtime swap --instance demo --bundle bundles/next --now --json swap.json\n\n\
    The run loads the bundle beside the running one, verifies it against its golden values and warms it up. A bundle that does\n\
    not pass is refused, and the old one runs on. The new policy starts from its initial state, also with --now.\n\
    Ctrl-C, or the end of --timeout, withdraws a bundle that was not taken yet.\n\
    Exits 0 if the bundle was taken, else 1.")]
pub(super) struct SwapArguments {
    /// Name of the link: the --instance of the run
    #[arg(long, value_name = "NAME")]
    instance: String,
    /// The new bundle's folder, as the run sees it
    #[arg(long, value_name = "DIR")]
    bundle: PathBuf,
    /// Takes over after the running tick, instead of at the next episode's start
    #[arg(long)]
    now: bool,
    /// Longest wait in all, in seconds; 0 waits for ever
    #[arg(long, value_name = "SECONDS", default_value_t = 120.0, value_parser = super::seconds)]
    timeout: f64,
    /// Writes what happened to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report<'a> {
    instance: &'a str,
    bundle: &'a PathBuf,
    when: When,
    #[serde(flatten)]
    answer: &'a Answer,
    /// Time to load, verify and warm up, in s.
    prepared_s: Option<f64>,
    /// Time in all, in s.
    total_s: f64,
}

pub(super) fn run(arguments: &SwapArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    let stop = shared::stop_flag()?;
    let SwapArguments { instance, bundle, now, timeout, json } = arguments;
    let when = if *now { When::Now } else { When::Episode };
    let timeout = (*timeout > 0.0).then(|| Duration::from_secs_f64(*timeout));
    let bar = indicatif::ProgressBar::new_spinner().with_message("asking");
    bar.enable_steady_tick(Duration::from_millis(200));
    let (start, mut ready_s) = (Instant::now(), None);
    let answer =
        ask(&LinkSettings::new(instance), bundle, when, timeout, &stop, &mut |answer| match answer {
            Answer::Loading => bar.set_message("the run loads and verifies the bundle"),
            Answer::Ready { prepared_s } => {
                ready_s = Some(*prepared_s);
                bar.set_message(if *now { "ready" } else { "ready, waits for the next episode" });
            }
            _ => {}
        })?;
    bar.finish_and_clear();
    let total_s = start.elapsed().as_secs_f64();
    let report = Report { instance, bundle, when, answer: &answer, prepared_s: ready_s, total_s };
    shared::write_json(json.as_deref(), &report)?;
    match answer {
        Answer::Taken { task, preset, updates, .. } => {
            rcwm_models::outln!(
                "taken      {preset} bundle for {task} ({updates} updates) runs on instance {instance:?}; ready after {:.2} s, \
                 taken after {total_s:.2} s",
                ready_s.unwrap_or(total_s)
            );
            Ok(())
        }
        Answer::Refused { reason } => anyhow::bail!("not taken, the old policy runs on: {reason}"),
        Answer::Withdrawn | Answer::Loading | Answer::Ready { .. } => {
            anyhow::bail!(
                "not taken within {total_s:.1} s and withdrawn, the old policy runs on; wait longer, or use --now"
            )
        }
    }
}
