//! `rcwm-lab inspect`.

use std::path::PathBuf;

use clap::Args;
use rcwm_runtime::cli::shared;

/// Arguments of `inspect`.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  rcwm-lab inspect --bundle models/bundles/hammer --json inspect.json")]
pub(super) struct InspectArguments {
    /// The bundle's folder
    #[arg(long, value_name = "DIR")]
    bundle: PathBuf,
    /// Writes everything to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn run(arguments: &InspectArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    let bundle = shared::open_bundle(&arguments.bundle)?;
    let info = crate::inspect::inspect(&bundle)?;
    shared::write_json(arguments.json.as_deref(), &info)?;
    rcwm_models::out!("{}", info.text());
    Ok(())
}
