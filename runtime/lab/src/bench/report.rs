//! What was measured, for people and for machines.

use serde::Serialize;

use super::ablation::{BASELINE, SINGLE, split};
use super::system::Measured as MeasuredBundle;
use super::{Case, Conditions, ControlBench, Limit, Stalls, System};
use rcwm_runtime::engine::EngineSettings;
use rcwm_runtime::realtime::Granted;
use rcwm_runtime::telemetry::{Latency, Stage, Telemetry, table};

/// Latencies of one case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CaseBench {
    /// What was run.
    #[serde(flatten)]
    pub case: Case,
    /// The limit by arithmetic over the median: of one thread, or of two that share everything evenly.
    pub share_of_limit: f64,
    /// Ticks for which the second thread came too late, so that the first did without it.
    pub helper_late: u64,
    /// Percentiles per stage; `tick` is image in, action out.
    pub latency: Vec<Latency>,
}

/// One row of the table of steps.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Step {
    /// What was run.
    pub name: &'static str,
    /// Median between image and action.
    pub p50_us: f64,
    pub share_of_limit: f64,
}

/// A bench run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BenchReport {
    pub system: System,
    pub bundle: MeasuredBundle,
    /// Ticks of each case.
    pub ticks: usize,
    /// Median of tract as deployed over that of ONNX Runtime, which runs the five exported parts one after another with one thread;
    /// absent unless both ran.
    pub ratio_p50_vs_ort: Option<f64>,
    /// The same of tract with one thread.
    pub ratio_p50_vs_ort_single_thread: Option<f64>,
    /// Median of tract as deployed over that of ONNX Runtime with our schedule, with one thread or with two, whichever was faster.
    pub ratio_p50_vs_ort_split: Option<f64>,
    /// The same, both with one thread.
    pub ratio_p50_vs_ort_split_single_thread: Option<f64>,
    /// The limit by arithmetic over the median of tract as deployed; absent unless tract ran.
    pub share_of_limit: Option<f64>,
    /// The same of tract with one thread.
    pub share_of_limit_single_thread: Option<f64>,
    /// Three-nines over median of tract as deployed.
    pub p999_over_p50: Option<f64>,
    /// The same of tract with one thread.
    pub p999_over_p50_single_thread: Option<f64>,
    /// Arithmetic in registers that takes as long as tract's ticks, measured in the same rounds: the tails that are the machine's own.
    pub controls: Vec<ControlBench>,
    /// The limit of one thread.
    pub limit: Limit,
    /// What the machine takes from any thread.
    pub stalls: Stalls,
    /// What the system granted, where it was asked for real time.
    pub realtime: Option<Granted>,
    /// Every case.
    pub engines: Vec<CaseBench>,
}

impl BenchReport {
    pub(super) fn new(
        bundle: MeasuredBundle,
        ticks: usize,
        conditions: Conditions,
        runs: &[(Case, Telemetry)],
        helper_late: &[u64],
    ) -> Self {
        let Conditions { limit, stalls, granted, controls } = conditions;
        let engines: Vec<CaseBench> = runs
            .iter()
            .zip(helper_late)
            .map(|((case, telemetry), helper_late)| CaseBench {
                case: *case,
                helper_late: *helper_late,
                share_of_limit: share(&limit, case.settings, telemetry.latency(Stage::Tick).p50_us),
                latency: telemetry.latencies(),
            })
            .collect();
        let find = |settings: EngineSettings| engines.iter().find(|bench| bench.case.settings == settings);
        let (deployed, single, baseline) = (find(EngineSettings::tract()), find(SINGLE), find(BASELINE));
        let tail = |bench: &CaseBench| bench.tick().map(|tick| tick.p999_us / tick.p50_us);
        let p50 = |bench: Option<&CaseBench>| Some(bench?.tick()?.p50_us);
        let ratio = |ours, theirs| Some(p50(ours)? / p50(theirs)?);
        let (split_1, split_2) = (find(split(1)), find(split(2)));
        let split_is_faster_alone = p50(split_1) <= p50(split_2);
        Self {
            system: System::here(),
            bundle,
            ticks,
            ratio_p50_vs_ort: ratio(deployed, baseline),
            ratio_p50_vs_ort_single_thread: ratio(single, baseline),
            ratio_p50_vs_ort_split: ratio(deployed, if split_is_faster_alone { split_1 } else { split_2 }),
            ratio_p50_vs_ort_split_single_thread: ratio(single, split_1),
            share_of_limit: deployed.map(|bench| bench.share_of_limit),
            share_of_limit_single_thread: single.map(|bench| bench.share_of_limit),
            p999_over_p50: deployed.and_then(tail),
            p999_over_p50_single_thread: single.and_then(tail),
            controls,
            limit,
            stalls,
            realtime: granted,
            engines,
        }
    }

    /// The report for people.
    #[must_use]
    pub fn text(&self) -> String {
        let Limit { gemm_gflops, read_gb_per_s, convolution_us, weights_us, tick_us, .. } = self.limit;
        let mut text = format!(
            "bench      {} ({}, {}, {}), {} ticks each, interleaved\n\
             {}machine    {gemm_gflops:.1} GFLOP/s in matrix products, {read_gb_per_s:.1} GB/s of weights, one core each\n\
             limit      {tick_us:.1} us from image to action on one thread: convolutions {convolution_us:.1}, other weights \
             {weights_us:.1}\n",
            self.bundle.name,
            self.bundle.kind,
            self.bundle.preset,
            &self.bundle.sha256[..12],
            self.ticks,
            self.system.lines()
        );
        let Stalls { per_s, share, p50_us, max_us } = self.stalls;
        text += &format!(
            "stalls     a thread that only looks at the clock is stopped {per_s:.0} times a second for {p50_us:.0} us (median; at most \
             {max_us:.0}), {:.1} % of the time\n",
            100.0 * share
        );
        for line in self.realtime.iter().flat_map(Granted::lines) {
            text += &format!("realtime   {line}\n");
        }
        for bench in &self.engines {
            let threads = bench.case.settings.threads;
            let late = match bench.helper_late {
                0 => String::new(),
                late => format!(", the second too late for {late} ticks"),
            };
            text += &format!("{:<10} {threads} thread(s){late}\n", bench.case.name);
            text += &table(&bench.latency);
        }
        for control in &self.controls {
            text += &control.line();
        }
        for (name, value) in [
            ("ratio_p50_vs_ort", self.ratio_p50_vs_ort),
            ("ratio_p50_vs_ort_single_thread", self.ratio_p50_vs_ort_single_thread),
            ("ratio_p50_vs_ort_split", self.ratio_p50_vs_ort_split),
            ("ratio_p50_vs_ort_split_single_thread", self.ratio_p50_vs_ort_split_single_thread),
            ("share_of_limit", self.share_of_limit),
            ("share_of_limit_single_thread", self.share_of_limit_single_thread),
            ("p999_over_p50", self.p999_over_p50),
            ("p999_over_p50_single_thread", self.p999_over_p50_single_thread),
        ] {
            if let Some(value) = value {
                text += &format!("{name} {value:.3}\n");
            }
        }
        text
    }

    /// The steps of an ablation.
    #[must_use]
    pub fn steps(&self) -> Vec<Step> {
        let step = |bench: &CaseBench| {
            let p50_us = bench.tick()?.p50_us;
            Some(Step { name: bench.case.name, p50_us, share_of_limit: bench.share_of_limit })
        };
        self.engines.iter().filter_map(step).collect()
    }

    /// The steps for people, as a Markdown table.
    #[must_use]
    pub fn steps_text(&self) -> String {
        let mut text = format!(
            "| {} bundle, {} ticks | image to action, p50 us | share of the limit ({:.0} us on one thread) |\n| --- | --- | --- |\n",
            self.bundle.preset, self.ticks, self.limit.tick_us
        );
        for Step { name, p50_us, share_of_limit } in self.steps() {
            text += &format!("| {name} | {p50_us:.1} | {:.0} % |\n", 100.0 * share_of_limit);
        }
        text
    }
}

impl CaseBench {
    fn tick(&self) -> Option<&Latency> {
        self.latency.iter().find(|latency| latency.stage == Stage::Tick)
    }
}

fn share(limit: &Limit, settings: EngineSettings, p50_us: f64) -> f64 {
    limit.tick_us / settings.threads as f64 / p50_us
}
