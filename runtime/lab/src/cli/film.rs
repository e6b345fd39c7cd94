//! `rcwm-lab film`.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use rcwm_runtime::cli::shared;
use rcwm_runtime::log::LogReader;

use super::replay::with_bar;
use crate::film::{Filmed, film};
use crate::log::Replayer;

/// Arguments of `film`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    rcwm-runtime run --bundle models/bundles/hammer --instance demo --log runs/demo.rcwmlog\n  \
    rcwm-lab film --log runs/demo.rcwmlog --bundle models/bundles/hammer --out runs/demo\n\n\
    A GIF, a strip of ten moments (PNG) and, where no observation was lost, a Dreamer's .npz of each episode. The run is replayed,\n\
    so that the model's reconstruction is that of the states it had. Without --bundle only what was seen is shown.")]
pub(super) struct FilmArguments {
    /// The log
    #[arg(long, value_name = "FILE")]
    log: PathBuf,
    /// The bundle's folder; again for each bundle that took over while the run went on
    #[arg(long, value_name = "DIR")]
    bundle: Vec<PathBuf>,
    /// Folder of the films; numbers go on behind the episodes that are there
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Films at most this many episodes
    #[arg(long, value_name = "N", default_value_t = 3)]
    episodes: u64,
    /// Writes what was filmed to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn run(arguments: &FilmArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    for folder in &arguments.bundle {
        shared::open_bundle(folder)?;
    }
    let stop = shared::stop_flag()?;
    let mut log = LogReader::open(&arguments.log)?;
    let replayer = match arguments.bundle.is_empty() {
        true => None,
        false => Some(Replayer::new(log.header(), &arguments.bundle, None)?),
    };
    let filmed = with_bar(&stop, "filming", |go_on| {
        film(&mut log, replayer, &arguments.out, arguments.episodes, go_on)
    })?;
    shared::write_json(arguments.json.as_deref(), &filmed)?;
    let Filmed { films, episodes, broken_episodes, broken_because, log_damage } = filmed;
    for path in films.iter().chain(&episodes) {
        rcwm_models::outln!("recorded   {}", path.display());
    }
    if let Some(because) = broken_because {
        rcwm_models::outln!(
            "recorded   {broken_episodes} episode(s) without .npz, the first because of: {because}"
        );
    }
    log_damage
        .map_or(Ok(()), |damage| Err(anyhow::anyhow!(damage)))
        .context("all before the damage was filmed")
}
