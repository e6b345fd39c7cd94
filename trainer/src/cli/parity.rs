use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use candle_core::Device;
use rcwm_trainer::gpu::Share;
use rcwm_trainer::parity::{self, Group, GroupReport, Measure, Report};
use serde::Serialize;

/// Compare our model with a reference file of the authors' implementation; exit 1 beyond tolerance
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer parity tests/data/rcwm-small.safetensors
  rcwm-trainer parity tests/data/rcwm-small.safetensors --group observe --json parity.json
  rcwm-trainer parity tests/data/rcwm-small.safetensors --device cuda

On a GPU the groups of updates are compared (loss, gradients, what Adam makes of them), which depend
on everything before them. The tolerances are those of f32; other precisions fail them and show by
how much.")]
pub struct Parity {
    /// The reference file
    file: PathBuf,
    /// Compare this group only (repeatable); all by default
    #[arg(long = "group", value_enum, value_name = "NAME")]
    groups: Vec<Group>,
    #[command(flatten)]
    compute: super::ComputeArguments,
    /// Write every tensor's error as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Outcome<'a> {
    file: &'a PathBuf,
    passes: bool,
    #[serde(flatten)]
    report: &'a Report,
}

impl Parity {
    pub fn run(self) -> Result<ExitCode> {
        super::prepare_json(self.json.as_deref())?;
        let groups = if self.groups.is_empty() { Group::ALL.to_vec() } else { self.groups.clone() };
        let report = match self.compute.machine()? {
            None => {
                print_head();
                parity::check_file(&self.file, &groups, &Device::Cpu, &mut print_group)?
            }
            Some(machine) => {
                rcwm_models::outln!("updates by programs of kernels on {}", machine.name());
                print_head();
                parity::check_programs(&self.file, &groups, &Share::alone(machine), &mut print_group)?
            }
        };
        if let Some(path) = &self.json {
            super::write_json(path, &Outcome { file: &self.file, passes: report.passes(), report: &report })?;
        }
        print_end(&report);
        Ok(if report.passes() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
    }
}

fn print_head() {
    rcwm_models::outln!(
        "{:<17} {:>7} {:>10} {:>10}            worst tensor",
        "group",
        "tensors",
        "max error",
        "tolerance"
    );
}

/// As soon as it is known: a group takes up to some minutes.
fn print_group(group: &GroupReport) {
    let worst = group.worst();
    rcwm_models::outln!(
        "{:<17} {:>7} {:>10.2e} {:>10.0e} {}  {:<5}  {}",
        group.group.as_str(),
        group.comparisons.len(),
        worst.map_or(f32::NAN, |worst| worst.error_max),
        group.tolerance,
        match group.measure {
            Measure::Absolute => "abs",
            Measure::Relative => "rel",
        },
        if group.passes() { "ok" } else { "FAIL" },
        worst.map_or("", |worst| worst.name.as_str()),
    );
}

fn print_end(report: &Report) {
    for unchecked in &report.unchecked {
        rcwm_models::outln!("{:<17} {:>7} not checked", unchecked.prefix, unchecked.tensors);
    }
    let failed = report.groups.iter().filter(|group| !group.passes()).count();
    let left: usize = report.unchecked.iter().map(|unchecked| unchecked.tensors).sum();
    match failed {
        0 => rcwm_models::outln!(
            "all {} groups within tolerance; {left} tensors of the file not checked",
            report.groups.len()
        ),
        _ => rcwm_models::outln!("{failed} of {} groups beyond tolerance", report.groups.len()),
    }
}
