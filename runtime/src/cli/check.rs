//! `rcwm-runtime check`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use rcwm_models::files::read_capped;
use rcwm_models::interface::{Interface, Layout, Mismatch};
use serde::Serialize;

use super::shared;

/// Largest text of an interface that is read.
const BYTES_MAX: u64 = 1 << 20;

/// Arguments of `check`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  rcwm-runtime check models/src/interface/metaworld.toml
  rcwm-runtime check models/src/interface/metaworld.toml --bundle models/bundles/hammer

The file says what a robot offers: its states, cameras and actions with names, units and limits
(docs/own-robot.md). Nothing is started and nothing moves.

Exits 0 if the file is sound and the bundle fits in what it says: picture, rate, mode and limits of
the action. Bundles have no names, kinds and units yet.")]
pub(super) struct CheckArguments {
    /// The robot's interface, robot.toml
    robot: PathBuf,
    /// Bundle that is to drive it
    #[arg(long, value_name = "DIR")]
    bundle: Option<PathBuf>,
    /// Writes everything to this file as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report<'a> {
    robot: &'a Path,
    interface: &'a Interface,
    hash: String,
    observation_bytes: usize,
    action_bytes: usize,
    bundle: Option<&'a Path>,
    fits: Option<bool>,
    /// What a bundle of this version lets be compared.
    compared: &'static [&'static str],
    mismatches: &'a [Mismatch],
}

pub(super) fn run(arguments: &CheckArguments) -> anyhow::Result<()> {
    shared::prepare_json(arguments.json.as_deref())?;
    let robot = read(&arguments.robot)?;
    let bundle = arguments.bundle.as_deref().map(shared::open_bundle).transpose()?;
    let mismatches = bundle.as_ref().map(|bundle| bundle.manifest.mismatches(&robot));
    let layout = Layout::of(&robot);
    let report = Report {
        robot: &arguments.robot,
        interface: &robot,
        hash: robot.hash(),
        observation_bytes: layout.observation_bytes,
        action_bytes: layout.action_bytes,
        bundle: arguments.bundle.as_deref(),
        fits: mismatches.as_ref().map(Vec::is_empty),
        compared: &["camera size", "rate", "action mode", "action elements", "action limits"],
        mismatches: mismatches.as_deref().unwrap_or_default(),
    };
    shared::write_json(arguments.json.as_deref(), &report)?;
    describe(&robot, &report);
    let (Some(folder), Some(found)) = (&arguments.bundle, &mismatches) else { return Ok(()) };
    if found.is_empty() {
        rcwm_models::outln!("fits {} in sizes, rate, mode and limits", folder.display());
        rcwm_models::outln!(
            "names, kinds, units and states are not compared: bundles of version 1 have none"
        );
        return Ok(());
    }
    for mismatch in found {
        rcwm_models::outln!("  {mismatch}");
    }
    let things = if found.len() == 1 { "thing" } else { "things" };
    anyhow::bail!(
        "{} does not fit {} in {} {things}; change the robot's file or driver, or take a bundle that was learnt for it",
        arguments.robot.display(),
        folder.display(),
        found.len()
    )
}

fn read(path: &Path) -> anyhow::Result<Interface> {
    let bytes = read_capped(path, BYTES_MAX)?;
    let text = String::from_utf8(bytes).map_err(|_| {
        anyhow::anyhow!("{}: not a text (UTF-8); expected TOML with [interface]", path.display())
    })?;
    Interface::parse(&text).with_context(|| path.display().to_string())
}

fn describe(robot: &Interface, report: &Report<'_>) {
    let Report { hash, observation_bytes, action_bytes, .. } = report;
    rcwm_models::outln!("{} at {} Hz, interface {}", robot.name, robot.rate_hz, &hash[..12]);
    for state in &robot.state {
        let (name, kind, count, unit) = (&state.name, &state.kind, state.elements.len(), &state.unit);
        rcwm_models::outln!("  state   {name:<16} {kind:<28} {count:>4} x {unit}");
    }
    for camera in &robot.camera {
        let mask = if camera.mask.is_some() { ", with a mask" } else { "" };
        rcwm_models::outln!("  camera  {:<16} {}{mask}", camera.name, camera.size());
    }
    for action in &robot.action {
        let (name, kind, count, unit) = (&action.name, &action.kind, action.elements.len(), &action.unit);
        rcwm_models::outln!("  action  {name:<16} {kind:<28} {count:>4} x {unit}, {}", action.mode.name());
    }
    rcwm_models::outln!("  an observation takes {observation_bytes} bytes, an action {action_bytes}");
}
