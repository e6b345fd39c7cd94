//! One training update, split by part: time, flops, bytes, share of the gemm peak of the same run, and memory.

mod arithmetic;
mod case;
mod gpu;
mod report;

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use case::{Bench, Case, Times};
use clap::{Parser, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_gpu::Precision;
use rcwm_models::errors::one_line;
use rcwm_models::files::write_atomic;
use report::Report;

/// Measures one training update of the RCWM and of actor and critic, by part.
///
/// Experience is made up; everything else is what training does. After every update a product is timed, whose rate is the peak
/// that the parts are compared with.
#[derive(Debug, Parser)]
#[command(
    name = "training-update",
    max_term_width = 110,
    after_help = "Examples:\n  training-update\n  training-update --sizes small,medium,paper --updates 5 --growth 0 --json speed.json"
)]
struct Arguments {
    /// Sizes of model and batch: small (8 x 32), medium (16 x 32), paper (16 x 64)
    #[arg(long, value_delimiter = ',', value_enum, default_value = "small")]
    sizes: Vec<Size>,
    /// Measured updates of each size, after one that warms up
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    updates: u32,
    /// Measured updates of each point of the growth series over batch, length and width; 0 leaves it out
    #[arg(long, value_name = "N", default_value_t = 3)]
    growth: u32,
    /// Where updates run: cpu, or cuda (the first NVIDIA GPU)
    #[arg(long, value_enum, default_value = "cpu")]
    device: DeviceKind,
    /// Precision of matrix products on a GPU
    #[arg(long, value_delimiter = ',', value_enum, default_value = "f32")]
    precision: Vec<Products>,
    /// Batches on a GPU, in place of the sizes' own
    #[arg(long, value_name = "B", value_delimiter = ',')]
    batch: Vec<usize>,
    /// Learners at once on a GPU
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=16))]
    together: u32,
    /// Each learner with programs of its own, in place of one program for all
    #[arg(long)]
    apart: bool,
    /// So many of the dearest kinds of commands on a GPU
    #[arg(long, value_name = "N", default_value_t = 0)]
    commands: usize,
    /// Writes the results as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DeviceKind {
    Cpu,
    Cuda,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Products {
    F32,
    Tf32,
}

impl From<Products> for Precision {
    fn from(products: Products) -> Self {
        match products {
            Products::F32 => Self::F32,
            Products::Tf32 => Self::Tf32,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Size {
    Small,
    Medium,
    Paper,
}

impl Size {
    fn case(self) -> Case {
        match self {
            Self::Small => Case::small(),
            Self::Medium => Case::medium(),
            Self::Paper => Case::paper(),
        }
    }
}

#[derive(serde::Serialize)]
struct Results {
    sizes: Vec<Report>,
    growth: Vec<Report>,
    gpu: Vec<gpu::GpuReport>,
}

fn main() -> ExitCode {
    rcwm_trainer::ops::leave_threads_to_ops();
    rcwm_trainer::ops::keep_freed_memory();
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            rcwm_models::errln!("training-update: {}", one_line(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<()> {
    let mut results = Results { sizes: Vec::new(), growth: Vec::new(), gpu: Vec::new() };
    if arguments.device == DeviceKind::Cuda {
        on_gpu(arguments, &mut results)?;
        return write(arguments, &results);
    }
    for size in &arguments.sizes {
        let report = measure(&size.case(), arguments.updates)?;
        report.print();
        results.sizes.push(report);
    }
    if arguments.growth > 0 {
        Report::print_heading();
        for case in Case::growth() {
            let report = measure(&case, arguments.growth)?;
            report.print_line();
            results.growth.push(report);
        }
    }
    write(arguments, &results)
}

fn on_gpu(arguments: &Arguments, results: &mut Results) -> Result<()> {
    for size in &arguments.sizes {
        let own = size.case();
        let batches =
            if arguments.batch.is_empty() { vec![own.scale.batch] } else { arguments.batch.clone() };
        for batch in batches {
            let mut case = own.clone();
            case.scale.batch = batch;
            for precision in &arguments.precision {
                let together = arguments.together as usize;
                let many = (arguments.updates, together, arguments.apart);
                let report = gpu::measure(&case, 0, (*precision).into(), many, arguments.commands)?;
                report.print();
                results.gpu.push(report);
            }
        }
    }
    Ok(())
}

fn write(arguments: &Arguments, results: &Results) -> Result<()> {
    if let Some(path) = &arguments.json {
        let text = serde_json::to_vec_pretty(results)?;
        write_atomic(path, &text).with_context(|| format!("{}: not written", path.display()))?;
    }
    Ok(())
}

fn measure(case: &Case, updates: u32) -> Result<Report> {
    let bar = if std::io::stderr().is_terminal() {
        ProgressBar::new(u64::from(updates) + 1)
    } else {
        ProgressBar::hidden()
    };
    bar.set_style(ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} updates, {eta} left")?);
    bar.set_message(case.name.clone());
    let mut bench = Bench::new(case)?;
    bench.update(&mut Times::default())?;
    bar.inc(1);
    let mut times = Times::default();
    for _ in 0..updates {
        bench.update(&mut times)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Report::new(case, &times)
}
