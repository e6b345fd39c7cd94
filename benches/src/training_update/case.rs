//! One size of model and batch: real updates on made-up experience, timed by part.

use std::collections::BTreeMap;
use std::fs;
use std::hint::black_box;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use candle_core::{Device, Tensor};
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_models::{ACTION_LEN, IMAGE_BYTES};
use rcwm_trainer::behaviour::{BehaviourLearner, BehaviourSettings};
use rcwm_trainer::learning::parts::{PartTime, listen};
use rcwm_trainer::learning::{Batch, HostBatch, Trained, WorldLearner, WorldSettings};
use rcwm_trainer::model::agent;
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::ops;

use crate::arithmetic::{Scale, Work, adam, parts};

/// What is measured.
#[derive(Debug, Clone)]
pub struct Case {
    /// Its name in the report.
    pub name: String,
    /// Sizes of the model.
    pub settings: ModelSettings,
    /// Sizes of the batch.
    pub scale: Scale,
}

impl Case {
    /// The reference small update.
    pub fn small() -> Self {
        let settings = ModelSettings::preset(Preset::Small, ModelKind::Rcwm);
        Self { name: "small".to_owned(), settings, scale: Scale { batch: 8, length: 32, horizon: 15 } }
    }

    /// Between the two.
    pub fn medium() -> Self {
        let settings = ModelSettings {
            cnn_depth: 16,
            categoricals: 24,
            classes: 24,
            deter: 192,
            hidden: 192,
            units: 256,
            ..ModelSettings::preset(Preset::Small, ModelKind::Rcwm)
        };
        Self { name: "medium".to_owned(), settings, scale: Scale { batch: 16, length: 32, horizon: 15 } }
    }

    /// The paper's update.
    pub fn paper() -> Self {
        let settings = ModelSettings::preset(Preset::Paper, ModelKind::Rcwm);
        Self { name: "paper".to_owned(), settings, scale: Scale { batch: 16, length: 64, horizon: 15 } }
    }

    /// The small update with one size changed at a time.
    pub fn growth() -> Vec<Self> {
        let small = Self::small();
        let scaled = |name: String, scale: Scale| Self { name, scale, ..small.clone() };
        let batches =
            [4, 8, 16, 32].map(|batch| scaled(format!("batch {batch}"), Scale { batch, ..small.scale }));
        let lengths =
            [16, 32, 64].map(|length| scaled(format!("length {length}"), Scale { length, ..small.scale }));
        let widths = [64, 128, 256].map(|width| {
            let settings =
                ModelSettings { deter: width, hidden: width, units: width, ..small.settings.clone() };
            Self { name: format!("width {width}"), settings, scale: small.scale }
        });
        batches.into_iter().chain(lengths).chain(widths).collect()
    }

    /// Flops and bytes of every part.
    pub fn work(&self) -> Result<BTreeMap<&'static str, Work>> {
        let mut work: BTreeMap<_, _> = parts(&self.settings, self.scale).into_iter().collect();
        let specs = agent::specs(&self.settings)?;
        let count = |trained: Trained| -> usize {
            let trained = specs.iter().filter(|spec| trained.filter()(&spec.name));
            trained.map(|spec| spec.shape.iter().product::<usize>()).sum()
        };
        work.insert("world Adam", adam(count(Trained::World)));
        work.insert("behaviour Adam", adam(count(Trained::Behaviour)));
        // Read both copies, write one.
        let critic = count(Trained::Critic) as f64;
        work.insert("slow critic", Work { flops: 3.0 * critic, bytes: 12.0 * critic });
        Ok(work)
    }
}

/// Times of a case.
#[derive(Debug, Default)]
pub struct Times {
    /// Of every part, in the order in which they run: of every update.
    pub parts: Vec<(&'static str, Vec<Duration>)>,
    /// Updates of the world model, from the batch to the moved weights.
    pub world: Vec<Duration>,
    /// Updates of the behaviour, from the posteriors to the moved weights.
    pub behaviour: Vec<Duration>,
    /// Flops a second of the baseline, measured after each update.
    pub peaks: Vec<f64>,
    /// Largest resident memory of the process during the case, in bytes; 0 where the system does not tell.
    pub memory_bytes: u64,
}

/// A case's learners and batch.
pub struct Bench {
    batch: Batch,
    world: WorldLearner,
    behaviour: BehaviourLearner,
    sampler: Sampler,
    peak: Peak,
}

impl Bench {
    pub fn new(case: &Case) -> Result<Self> {
        forget_memory();
        let parameters: Parameters = agent::initialise(&case.settings, 1, &Device::Cpu)?;
        Ok(Self {
            batch: host_batch(case.scale).into_tensors(&Device::Cpu)?,
            world: WorldLearner::new(&parameters, &case.settings, &WorldSettings::default(), Trained::World)?,
            behaviour: BehaviourLearner::new(&parameters, &case.settings, &behaviour_settings(case.scale))?,
            sampler: Sampler::seeded(1),
            peak: Peak::new()?,
        })
    }

    /// One update of world model and behaviour, then one product.
    pub fn update(&mut self, times: &mut Times) -> Result<()> {
        let start = Instant::now();
        let (world, mut parts) = listen(|| self.world.update(&self.batch, &mut self.sampler));
        let start_states = world?.posteriors.map(|x| x.flatten(0, 1))?; // [B*T, ...]
        times.world.push(start.elapsed());
        let start = Instant::now();
        let (behaviour, more) = listen(|| self.behaviour.update(&start_states, &mut self.sampler));
        behaviour?;
        times.behaviour.push(start.elapsed());
        parts.extend(more);
        for PartTime { part, time } in parts {
            match times.parts.iter_mut().find(|(name, _)| *name == part) {
                Some((_, all)) => all.push(time),
                None => times.parts.push((part, vec![time])),
            }
        }
        times.peaks.push(self.peak.measure()?);
        times.memory_bytes = memory_bytes().unwrap_or_default();
        Ok(())
    }
}

/// The paper's, with this horizon.
pub fn behaviour_settings(scale: Scale) -> BehaviourSettings {
    let mut settings = BehaviourSettings::default();
    settings.horizon.length = scale.horizon;
    settings
}

/// Numbers that repeat at no power of two; their values do not matter for the time.
pub fn host_batch(Scale { batch, length, .. }: Scale) -> HostBatch {
    let steps = batch * length;
    HostBatch {
        side: 64,
        rows: batch,
        length,
        image: (0..steps * IMAGE_BYTES).map(|i| (i / 7 % 251) as u8).collect(),
        action: (0..steps * ACTION_LEN).map(|i| (i % 19) as f32 / 10.0 - 0.9).collect(),
        reward: (0..steps).map(|i| (i % 11) as f32).collect(),
        terminal: vec![false; steps],
        first: (0..steps).map(|i| i % (length + 5) == 11).collect(),
        pushed: vec![false; steps],
        ..HostBatch::default()
    }
}

/// The baseline: a product whose right factor stays in the cache, on all threads, by the kernel that the updates use.
struct Peak {
    rows: Tensor,
    square: Tensor,
}

/// Large enough that packing and waking threads vanish, small enough to take 10 ms.
const PEAK_ROWS: usize = 2048;
const PEAK_SIDE: usize = 512;
/// The fastest of so many counts: the others waited for the machine.
const PEAK_TRIES: usize = 3;

impl Peak {
    fn new() -> Result<Self> {
        let matrix = |rows: usize| {
            let values: Vec<f32> = (0..rows * PEAK_SIDE).map(|i| (i % 13) as f32 - 6.0).collect();
            Tensor::from_vec(values, (rows, PEAK_SIDE), &Device::Cpu)
        };
        Ok(Self { rows: matrix(PEAK_ROWS)?, square: matrix(PEAK_SIDE)? })
    }

    /// Flops a second.
    fn measure(&self) -> Result<f64> {
        let mut least = f64::INFINITY;
        for _ in 0..PEAK_TRIES {
            let start = Instant::now();
            black_box(ops::linear(&self.rows, &self.square, None)?);
            least = least.min(start.elapsed().as_secs_f64());
        }
        Ok(2.0 * (PEAK_ROWS * PEAK_SIDE * PEAK_SIDE) as f64 / least)
    }
}

/// Starts the process's high-water mark of memory anew, where the system allows it; else it only grows from case to case.
fn forget_memory() {
    ops::return_freed_memory();
    let _ = fs::write("/proc/self/clear_refs", "5");
}

fn memory_bytes() -> Result<u64> {
    let status = fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).context("no VmHWM")?;
    let number = line.trim().trim_end_matches("kB").trim();
    Ok(1024 * number.parse::<u64>()?)
}
