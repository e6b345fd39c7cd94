//! The tick's latency on this machine, engines interleaved in one run on the bundle's golden images.
//!
//! What varies with the machine's mood (clock, neighbours) then hits all engines alike: in every round each engine runs one tick,
//! and the order turns by one from round to round.

mod limit;

pub use limit::{Limit, measure_machine};

use std::time::Instant;

use rcwm_models::ACTION_LEN;
use rcwm_models::bundle::Bundle;
use rcwm_models::tensors::TensorsError;
use serde::Serialize;

use crate::engine::{EngineKind, EngineSettings};
use crate::inspect::{InspectError, inspect};
use crate::policy::{Policy, PolicyError, Sampling};
use crate::telemetry::{Latency, Stage, Telemetry, table};

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The policy failed.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The golden images are unusable.
    #[error("golden values: {0}")]
    Golden(#[from] TensorsError),
    /// The cost of a tick is unknown.
    #[error(transparent)]
    Inspect(#[from] InspectError),
    /// The machine's limits could not be measured.
    #[error("measuring the machine: {0}")]
    Machine(String),
}

/// Latencies of one engine.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EngineBench {
    /// The engine.
    pub engine: EngineKind,
    /// Threads inside an operator.
    pub threads: usize,
    /// Percentiles per stage; `tick` is image in, action out.
    pub latency: Vec<Latency>,
}

/// A bench run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BenchReport {
    /// Preset of the bundle.
    pub preset: String,
    /// Ticks of each engine.
    pub ticks: usize,
    /// tract's median over that of ONNX Runtime with two threads; absent unless both ran.
    pub ratio_p50_vs_ort: Option<f64>,
    /// tract's median over that of ONNX Runtime with one thread; absent unless both ran.
    pub ratio_p50_vs_ort_single_thread: Option<f64>,
    /// The limit by arithmetic over tract's median; absent unless tract ran.
    pub share_of_limit: Option<f64>,
    /// The limit.
    pub limit: Limit,
    /// Every engine.
    pub engines: Vec<EngineBench>,
}

struct Runner {
    settings: EngineSettings,
    policy: Policy,
    telemetry: Telemetry,
}

/// Runs every engine for `ticks` ticks after a tenth of them unmeasured. `go_on` is asked after every round.
///
/// # Errors
/// See [`BenchError`].
pub fn bench(
    bundle: &Bundle,
    engines: &[EngineSettings],
    ticks: usize,
    go_on: &mut dyn FnMut() -> bool,
) -> Result<BenchReport, BenchError> {
    let limit = measure_machine()?.of(&inspect(bundle)?.tick);
    let mut runners = engines
        .iter()
        .map(|settings| {
            let policy = Policy::new(bundle, *settings, Sampling::Mode)?;
            Ok(Runner { settings: *settings, policy, telemetry: Telemetry::new() })
        })
        .collect::<Result<Vec<_>, PolicyError>>()?;
    let images = bundle.golden.u8("input/image")?;
    let count = images.shape().first().copied().unwrap_or(0);
    let images = images.as_slice().filter(|_| count > 0);
    let images = images.ok_or(TensorsError::Missing { name: "input/image, at least one tick".into() })?;
    let image_len = images.len() / count;
    let warm_up = ticks / 10;
    let mut measured = 0;
    for round in 0..warm_up + ticks {
        let image = &images[round % count * image_len..][..image_len];
        for turn in 0..runners.len() {
            let index = (round + turn) % engines.len();
            runners[index].tick(image, round % count == 0, round >= warm_up)?;
        }
        measured += usize::from(round >= warm_up);
        if !go_on() {
            break;
        }
    }
    Ok(report(bundle, measured, limit, &runners))
}

impl Runner {
    fn tick(&mut self, image: &[u8], is_first: bool, measured: bool) -> Result<(), PolicyError> {
        let start = Instant::now();
        let decision = self.policy.observe(image, (!is_first).then_some(&[0.1; ACTION_LEN]))?;
        let tick_ns = start.elapsed().as_nanos() as u64;
        if measured {
            self.telemetry.record(Stage::Tick, tick_ns);
            for (stage, time_ns) in Stage::POLICY.into_iter().zip(decision.stage_ns) {
                self.telemetry.record(stage, time_ns);
            }
        }
        Ok(())
    }

    fn p50_us(&self) -> f64 {
        self.telemetry.latency(Stage::Tick).p50_us
    }
}

fn report(bundle: &Bundle, ticks: usize, limit: Limit, runners: &[Runner]) -> BenchReport {
    let p50_us = |settings: EngineSettings| {
        runners.iter().find(|runner| runner.settings == settings).map(Runner::p50_us)
    };
    let tract_us = p50_us(EngineSettings::tract());
    let ratio = |threads: usize| Some(tract_us? / p50_us(EngineSettings::ort(threads))?);
    BenchReport {
        preset: bundle.manifest.provenance.preset.clone(),
        ticks,
        ratio_p50_vs_ort: ratio(2),
        ratio_p50_vs_ort_single_thread: ratio(1),
        share_of_limit: tract_us.map(|tract_us| limit.tick_us / tract_us),
        limit,
        engines: runners
            .iter()
            .map(|runner| EngineBench {
                engine: runner.settings.kind,
                threads: runner.settings.threads,
                latency: runner.telemetry.latencies(),
            })
            .collect(),
    }
}

impl BenchReport {
    /// The report for people.
    #[must_use]
    pub fn text(&self) -> String {
        let Limit { gemm_gflops, read_gb_per_s, tick_us, .. } = self.limit;
        let mut text = format!(
            "bench      {} bundle, {} ticks an engine, interleaved\n\
             machine    {gemm_gflops:.1} GFLOP/s in matrix products, {read_gb_per_s:.1} GB/s read, one core each; a tick takes at \
             least {tick_us:.1} us\n",
            self.preset, self.ticks
        );
        for engine in &self.engines {
            text += &format!("engine     {}, {} thread(s)\n", engine.engine, engine.threads);
            text += &table(&engine.latency);
        }
        for (name, value) in [
            ("ratio_p50_vs_ort", self.ratio_p50_vs_ort),
            ("ratio_p50_vs_ort_single_thread", self.ratio_p50_vs_ort_single_thread),
            ("share_of_limit", self.share_of_limit),
        ] {
            if let Some(value) = value {
                text += &format!("{name} {value:.3}\n");
            }
        }
        text
    }
}
