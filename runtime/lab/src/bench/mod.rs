//! The tick's latency on this machine, several ways of running it interleaved in one run on the bundle's golden images.
//!
//! What varies with the machine's mood (clock, neighbours) then hits all alike: in every round each runs one tick, and the order turns by one
//! from round to round. `tick` is image in, action out; what is worked ahead of the image is `ahead`, measured beside it. How much of the tails is the
//! machine's own shows a control in the same rounds.

mod ablation;
mod control;
mod limit;
mod report;
mod system;

pub use ablation::{Case, ablation, engines};
pub use control::ControlBench;
pub use limit::{Limit, Machine, Stalls, measure_machine, measure_stalls};
pub use report::{BenchReport, CaseBench, Step};
pub use system::{Measured as MeasuredBundle, System};

use std::time::{Duration, Instant};

use rcwm_models::bundle::Bundle;
use rcwm_models::wire::ActionValues;

use crate::inspect::{Cost, CostError, InspectError, inspect};
use crate::plot::{Curve, PlotError, plot};
use rcwm_runtime::compile::{CompileError, Optimizations, compile};
use rcwm_runtime::engine::EngineSettings;
use rcwm_runtime::policy::{Inputs, Policy, PolicyError, Sampling};
use rcwm_runtime::realtime;
use rcwm_runtime::telemetry::{LatencyFiles, Stage, Telemetry};
use rcwm_runtime::verify::{Golden, VerifyError};

use ablation::SINGLE;
use control::Control;

/// Most ticks of the warm-up.
const WARM_UP_MAX: usize = 2000;

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The policy failed.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The golden images are unusable.
    #[error(transparent)]
    Golden(#[from] VerifyError),
    /// The cost of a tick is unknown.
    #[error(transparent)]
    Inspect(#[from] InspectError),
    /// The cost of what needs the image is unknown.
    #[error("cost of a tick: {0}")]
    Cost(#[from] CostError),
    /// The parts could not be taken apart.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// The manifest can no longer be read.
    #[error(transparent)]
    File(#[from] rcwm_models::files::FileError),
    /// It was ended before the warm-up was over.
    #[error("stopped before a tick was measured: give it more time, or fewer --ticks")]
    Stopped,
    /// The machine's limits could not be measured.
    #[error("measuring the machine: {0}")]
    Machine(String),
}

struct Runner {
    case: Case,
    policy: Policy,
    telemetry: Telemetry,
    /// What was measured before the measurement.
    warm_up: Telemetry,
    executed: Option<ActionValues>,
    helper_late: u64,
}

/// Runs every case for `ticks` ticks after a tenth of them, at most 2000, unmeasured. With `real_time`, the calling thread and the ticks' second
/// threads get a fixed priority and the process locked memory, as far as the system grants it. `go_on` is asked after every round.
pub fn bench(
    bundle: &Bundle,
    cases: &[Case],
    ticks: usize,
    real_time: Option<realtime::Request>,
    go_on: &mut dyn FnMut() -> bool,
) -> Result<Measured, BenchError> {
    let of = MeasuredBundle::of(bundle)?;
    let machine = measure_machine(inspect(bundle)?.tick.weight_bytes)?;
    let limit = machine.of(&late_cost(bundle)?);
    let mut runners = cases.iter().map(|case| Runner::new(bundle, *case)).collect::<Result<Vec<_>, _>>()?;
    let granted = real_time.and_then(realtime::ask);
    let stalls = measure_stalls();
    let golden = Golden::of(bundle)?;
    let count = golden.ticks;
    let warm_up = (ticks / 10).min(WARM_UP_MAX);
    let mut controls = Vec::new();
    let mut measured = 0;
    let mut rested = Instant::now();
    for round in 0..warm_up + ticks {
        if round == warm_up {
            controls = make_controls(&runners)?;
            // Threads that have begun only now.
            let _ = real_time.map(realtime::ask_for_helpers);
        }
        let inputs = golden.inputs(round % count)?;
        for turn in 0..runners.len() {
            let index = (round + turn) % cases.len();
            runners[index].tick(inputs, round % count == 0, round >= warm_up)?;
        }
        controls.iter_mut().for_each(Control::measure);
        measured += usize::from(round >= warm_up);
        if granted.is_some() {
            // As a controller rests between its ticks; a thread of a fixed priority that never does is stopped for some time.
            std::thread::sleep(rested.elapsed() / 8);
            rested = Instant::now();
        }
        if !go_on() {
            break;
        }
    }
    if measured == 0 {
        return Err(BenchError::Stopped);
    }
    let controls = controls.iter().map(Control::report).collect();
    let conditions = Conditions { limit, stalls, granted, controls };
    let late: Vec<u64> = runners.iter().map(|runner| runner.helper_late).collect();
    let runs: Vec<(Case, Telemetry)> =
        runners.into_iter().map(|runner| (runner.case, runner.telemetry)).collect();
    Ok(Measured { report: BenchReport::new(of, measured, conditions, &runs, &late), runs })
}

/// One for tract on one thread and one for tract as deployed, where they run; they take as long as those took in the warm-up.
fn make_controls(runners: &[Runner]) -> Result<Vec<Control>, BenchError> {
    let deployed = EngineSettings::tract();
    let mut settings = vec![SINGLE];
    settings.extend((deployed.threads > 1).then_some(deployed));
    let mut controls = Vec::new();
    for settings in settings {
        let runs = |runner: &&Runner| runner.case.settings == settings && runner.case.warms_caches;
        if let Some(runner) = runners.iter().find(runs) {
            let p50_us = runner.warm_up.latency(Stage::Tick).p50_us;
            controls.push(Control::new(settings.threads, Duration::from_secs_f64(p50_us / 1e6))?);
        }
    }
    Ok(controls)
}

/// Under which conditions was measured.
pub(crate) struct Conditions {
    limit: Limit,
    stalls: Stalls,
    granted: Option<realtime::Granted>,
    controls: Vec<ControlBench>,
}

/// What was measured: the report, and every time behind it.
pub struct Measured {
    /// Sums and ratios.
    pub report: BenchReport,
    /// Histograms of each case.
    pub runs: Vec<(Case, Telemetry)>,
}

impl Measured {
    /// Writes what was asked for: a folder of percentile files a case, and the cases' ticks as lines of one plot.
    pub fn write(&self, files: &LatencyFiles) -> Result<(), PlotError> {
        if let Some(folder) = &files.hgrm {
            for (case, telemetry) in &self.runs {
                let plain: String = case.name.chars().filter(|c| c.is_alphanumeric() || *c == ' ').collect();
                telemetry.write_hgrm(&folder.join(plain.trim().replace(' ', "-")))?;
            }
        }
        if let Some(file) = &files.plot {
            let of = |(case, telemetry): &(Case, Telemetry)| {
                Curve::of(case.name, telemetry.histogram(Stage::Tick))
            };
            let curves: Vec<_> = self.runs.iter().map(of).collect();
            let title = format!(
                "image to action, {} bundle, {} ticks each",
                self.report.bundle.preset, self.report.ticks
            );
            plot(file, &title, &curves, None)?;
        }
        Ok(())
    }
}

/// Cost of what stands between image and action, by the exported files' own operators.
fn late_cost(bundle: &Bundle) -> Result<Cost, BenchError> {
    let mut cost = Cost::default();
    for segment in compile(bundle, Optimizations::NONE)?.iter().filter(|segment| segment.late) {
        cost = cost.plus(&Cost::of(&segment.onnx)?);
    }
    Ok(cost)
}

impl Runner {
    fn new(bundle: &Bundle, case: Case) -> Result<Self, PolicyError> {
        let policy = Policy::new(bundle, case.settings, Sampling::Mode)?;
        let (telemetry, warm_up) = (Telemetry::new(), Telemetry::new());
        Ok(Self { case, policy, telemetry, warm_up, executed: None, helper_late: 0 })
    }

    /// Ahead first, as a controller does after it has sent an action, then ready for the image, as it does before one is expected; then the
    /// image, as if it came now.
    fn tick(&mut self, inputs: Inputs<'_>, is_first: bool, measured: bool) -> Result<(), PolicyError> {
        let executed = self.executed.filter(|_| !is_first);
        let start = Instant::now();
        self.policy.work_ahead(executed.as_ref())?;
        let ahead_ns = start.elapsed().as_nanos() as u64;
        let start = Instant::now();
        if self.case.warms_caches {
            self.policy.warm_caches()
        } else {
            self.policy.wake()
        }
        let ready_ns = start.elapsed().as_nanos() as u64;
        let start = Instant::now();
        let decision = self.policy.observe(inputs, executed.as_ref())?;
        let tick_ns = start.elapsed().as_nanos() as u64;
        self.executed = Some(decision.action);
        if !measured {
            self.warm_up.record(Stage::Tick, tick_ns);
        } else {
            self.helper_late += u64::from(decision.helper_late);
            self.telemetry.record(Stage::Tick, tick_ns);
            self.telemetry.record(Stage::Ahead, ahead_ns);
            self.telemetry.record(Stage::Ready, ready_ns);
            self.telemetry.record_policy(&decision.stage_ns);
        }
        Ok(())
    }
}
