//! `rcwm-lab bundle`.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use rcwm_models::interface::Interface;
use rcwm_models::tasks;
use rcwm_runtime::cli::shared;
use serde::Serialize;

use crate::bundle::{Request, build, list};

/// Arguments of `bundle`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  rcwm-lab bundle --onnx policy.onnx --interface models/src/interface/arm.toml --out bundles/policy
  rcwm-lab bundle --onnx lstm.onnx --interface models/src/interface/arm.toml --out bundles/lstm \\
      --rename obs=state --rename actions=action --carry h_in=h_out --carry c_in=c_out

The graph's inputs are cameras by their names (or `image`), `state`, `executed_action` and carried
`state.NAME`; its outputs `action` (-1 to 1, from limit to limit) and `next_state.NAME`. Shapes and how pictures
enter: docs/own-policy.md. Missing frames: the last action is held for --imagined-ticks-max ticks, then the fallback.")]
pub(super) struct BundleArguments {
    /// The policy: one self-contained ONNX file, operator set 17 to 21, f32, batch 1
    #[arg(long, value_name = "FILE")]
    onnx: PathBuf,
    /// The robot that it is for, a file with [interface]; Meta-World's arm without one
    #[arg(long, value_name = "ROBOT.TOML")]
    interface: Option<PathBuf>,
    /// Folder of the bundle
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Cameras and states that the policy reads, in its order; by default those that its inputs name, and all states
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    inputs: Option<Vec<String>>,
    /// Another name for an input or output (repeatable)
    #[arg(long, value_name = "FROM=TO", value_parser = pair)]
    rename: Vec<(String, String)>,
    /// An input that is fed with an output of the last tick (repeatable)
    #[arg(long, value_name = "IN=OUT", value_parser = pair)]
    carry: Vec<(String, String)>,
    /// What is carried into the first tick of an episode: safetensors with state.NAME; zeros without
    #[arg(long, value_name = "FILE")]
    initial: Option<PathBuf>,
    /// Golden values from the policy's own library (safetensors, docs/own-policy.md); recorded here without
    #[arg(long, value_name = "FILE", conflicts_with = "golden_ticks")]
    golden: Option<PathBuf>,
    /// Ticks of golden values that are recorded here
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=1000))]
    golden_ticks: u16,
    /// Task the policy was made for, one of Meta-World's or `own`
    #[arg(long, default_value = "own")]
    task: String,
    /// Replace a bundle that is there
    #[arg(long)]
    force: bool,
    /// Writes the manifest to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report<'a> {
    bundle: &'a PathBuf,
    manifest: &'a rcwm_models::bundle::Manifest,
}

fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((from, to)) if !from.is_empty() && !to.is_empty() => Ok((from.to_owned(), to.to_owned())),
        _ => Err("expected two names, as in obs=state".into()),
    }
}

pub(super) fn run(arguments: &BundleArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    if arguments.task != tasks::task_name(tasks::OWN_TASK) {
        tasks::task_id(&arguments.task).context("--task")?;
    }
    let interface =
        arguments.interface.as_deref().map_or_else(|| Ok(Interface::metaworld()), Interface::read)?;
    let request = Request {
        onnx: arguments.onnx.clone(),
        interface,
        inputs: arguments.inputs.clone(),
        rename: arguments.rename.clone(),
        carry: arguments.carry.clone(),
        initial: arguments.initial.clone(),
        golden: arguments.golden.clone(),
        golden_ticks: arguments.golden_ticks.into(),
        task: arguments.task.clone(),
        replace: arguments.force,
    };
    let bundle = build(&request, &arguments.out)?;
    let manifest = &bundle.manifest;
    shared::write_json(arguments.json.as_deref(), &Report { bundle: &arguments.out, manifest })?;
    for part in &manifest.parts {
        rcwm_models::outln!("inputs     {}", list(&part.inputs));
        rcwm_models::outln!("outputs    {}", list(&part.outputs));
    }
    rcwm_models::outln!("origin     {}", manifest.provenance.data);
    rcwm_models::outln!("bundle in {}", arguments.out.display());
    Ok(())
}
