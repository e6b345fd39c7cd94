//! The same updates on a GPU: whole updates as they are replayed, and their parts run command by command.

use std::sync::{Arc, Barrier};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use candle_core::Device;
use rcwm_gpu::{Machine, Precision};
use rcwm_models::episode::Episode;
use rcwm_trainer::gpu::{GpuLearner, GpuPlan, Share, numbered_noise};
use rcwm_trainer::learning::WorldSettings;
use rcwm_trainer::model::agent;
use rcwm_trainer::replay::Placed;
use serde::Serialize;

use crate::case::{Case, behaviour_settings, host_batch};

/// A case's results on a GPU.
#[derive(Debug, Serialize)]
pub struct GpuReport {
    pub name: String,
    pub card: String,
    pub precision: String,
    pub batch: usize,
    pub length: usize,
    pub horizon: usize,
    /// Learners of different seeds that shared the card.
    pub together: usize,
    /// Whether each had programs of its own.
    pub apart: bool,
    pub updates: usize,
    /// Compiling the kernels, laying out the programs and capturing them.
    pub prepare_ms: f64,
    pub world_median_ms: f64,
    pub world_p90_ms: f64,
    pub behaviour_median_ms: f64,
    pub behaviour_p90_ms: f64,
    /// Updates of the world model alone, all learners together.
    pub world_updates_per_s: f64,
    pub world_commands: usize,
    pub behaviour_commands: usize,
    pub memory_mbyte: f64,
    pub parts: Vec<GpuPart>,
    /// The dearest kinds of commands, where they were asked for.
    pub dearest: Vec<GpuCommand>,
}

/// A kind of command: all of them in an update together, and one.
#[derive(Debug, Serialize)]
pub struct GpuCommand {
    pub program: &'static str,
    pub part: &'static str,
    pub name: String,
    pub count: usize,
    pub us: f64,
    pub all_ms: f64,
}

/// A part's time, run command by command.
#[derive(Debug, Serialize)]
pub struct GpuPart {
    pub program: &'static str,
    pub part: &'static str,
    pub commands: usize,
    pub ms: f64,
    pub gflop: f64,
    pub tflops_per_s: f64,
}

/// Updates of the world model alone that are made at once, for each that is timed by itself.
const ALONE: u32 = 5;

/// Measures a case on the GPU of this number, with so many learners at once: in programs that all share, or each with its own.
pub fn measure(
    case: &Case,
    ordinal: usize,
    precision: Precision,
    (updates, together, apart): (u32, usize, bool),
    commands_shown: usize,
) -> Result<GpuReport> {
    let machine = || Ok::<_, anyhow::Error>(Machine::nvidia(ordinal, precision)?);
    let shares = if apart {
        (0..together).map(|_| Ok(Share::alone(machine()?))).collect::<Result<Vec<_>>>()?
    } else {
        Share::all(machine()?.for_runs(together))
    };
    let barrier = Barrier::new(together);
    let found: Vec<Result<One>> = std::thread::scope(|scope| {
        let threads: Vec<_> = shares
            .iter()
            .enumerate()
            .map(|(seed, share)| {
                scope.spawn({
                    let barrier = &barrier;
                    move || one(case, share, updates, (seed as u64, commands_shown), barrier)
                })
            })
            .collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|_| Err(anyhow!("a learner's thread panicked"))))
            .collect()
    });
    let found = found.into_iter().collect::<Result<Vec<_>>>()?;
    let rate: f64 = found.iter().map(|one| f64::from(ALONE * updates) / one.world_alone.as_secs_f64()).sum();
    let first = found.into_iter().next().context("there is at least one learner")?;
    let parts = first
        .parts
        .iter()
        .map(|(program, part)| GpuPart {
            program,
            part: part.part,
            commands: part.commands,
            ms: part.ms,
            gflop: part.flops / 1e9,
            tflops_per_s: part.flops / part.ms / 1e9,
        })
        .collect();
    let at = |times: &[Duration], share: f64| {
        let mut ms: Vec<f64> = times.iter().map(|time| 1e3 * time.as_secs_f64()).collect();
        ms.sort_by(f64::total_cmp);
        ms.get((share * ms.len() as f64) as usize).copied().unwrap_or(f64::NAN)
    };
    Ok(GpuReport {
        name: case.name.clone(),
        card: first.card.clone(),
        precision: format!("{precision:?}").to_lowercase(),
        batch: case.scale.batch,
        length: case.scale.length,
        horizon: case.scale.horizon,
        together,
        apart,
        updates: updates as usize,
        prepare_ms: 1e3 * first.prepare.as_secs_f64(),
        world_median_ms: at(&first.world, 0.5),
        world_p90_ms: at(&first.world, 0.9),
        behaviour_median_ms: at(&first.behaviour, 0.5),
        behaviour_p90_ms: at(&first.behaviour, 0.9),
        world_updates_per_s: rate,
        world_commands: first.commands.0,
        behaviour_commands: first.commands.1,
        memory_mbyte: first.memory_bytes as f64 / 1e6,
        parts,
        dearest: first.dearest,
    })
}

struct One {
    card: String,
    prepare: Duration,
    world: Vec<Duration>,
    behaviour: Vec<Duration>,
    world_alone: Duration,
    commands: (usize, usize),
    memory_bytes: usize,
    parts: Vec<(&'static str, rcwm_gpu::machine::PartTime)>,
    dearest: Vec<GpuCommand>,
}

fn one(
    case: &Case,
    share: &Share,
    updates: u32,
    (seed, commands_shown): (u64, usize),
    barrier: &Barrier,
) -> Result<One> {
    let start = Instant::now();
    let made = make(case, share, seed);
    let prepare = start.elapsed();
    barrier.wait();
    let (mut learner, images) = made?;
    let batch = host_batch(case.scale);
    let stored = rcwm_gpu::learner::Images::Stored(&images);
    let mut number = 0;
    let mut world = |learner: &mut GpuLearner| {
        let start = Instant::now();
        learner.update_world_from(&batch, stored, &[], numbered_noise(seed, number))?;
        number += 1;
        Ok::<_, anyhow::Error>(start.elapsed())
    };
    for _ in 0..3 {
        world(&mut learner)?;
        learner.update_behaviour()?;
    }
    let (mut worlds, mut behaviours) = (Vec::new(), Vec::new());
    for _ in 0..updates {
        worlds.push(world(&mut learner)?);
        let start = Instant::now();
        learner.update_behaviour()?;
        behaviours.push(start.elapsed());
    }
    barrier.wait();
    let start = Instant::now();
    for _ in 0..ALONE * updates {
        world(&mut learner)?;
    }
    let world_alone = start.elapsed();
    barrier.wait();
    let mut parts = Vec::new();
    if seed == 0 {
        for _ in 0..2 {
            let (of_world, of_behaviour) = learner.learner_mut().time_parts()?;
            parts = of_world.into_iter().map(|part| ("world", part)).collect();
            parts.extend(of_behaviour.into_iter().map(|part| ("behaviour", part)));
        }
    }
    let mut dearest = Vec::new();
    if seed == 0 && commands_shown > 0 {
        let (of_world, of_behaviour) = learner.learner_mut().time_commands()?;
        for (program, times) in [("world", of_world), ("behaviour", of_behaviour)] {
            let row = |time: rcwm_gpu::machine::CommandTime| {
                let all_ms = time.us * time.count as f64 / 1e3;
                GpuCommand {
                    program,
                    part: time.part,
                    name: time.name,
                    count: time.count,
                    us: time.us,
                    all_ms,
                }
            };
            dearest.extend(times.into_iter().take(commands_shown).map(row));
        }
    }
    let inner = learner.learner_mut();
    let (card, memory_bytes) = inner.machine();
    let commands = inner.commands();
    Ok(One {
        card,
        prepare,
        world: worlds,
        behaviour: behaviours,
        world_alone,
        commands,
        memory_bytes,
        parts,
        dearest,
    })
}

/// A learner whose images lie on the card, and which of them the batch has.
fn make(case: &Case, share: &Share, seed: u64) -> Result<(GpuLearner, Vec<u32>)> {
    let parameters = agent::initialise(&case.settings, seed, &Device::Cpu)?;
    let (world, behaviour) = (WorldSettings::default(), behaviour_settings(case.scale));
    let count = case.scale.batch * case.scale.length;
    let mut episode = Episode::blank(count);
    for (to, from) in episode.image.iter_mut().zip(host_batch(case.scale).image) {
        *to = from;
    }
    let placed = Placed { episode: Arc::new(episode), images: 0, seen: 0 };
    let plan = GpuPlan {
        model: &case.settings,
        batch: (case.scale.batch, case.scale.length),
        world: &world,
        imitation: None,
        in_stages: false,
        behaviour: Some(&behaviour),
        average_decay: 0.0,
        stored: &[placed],
        looks: false,
        mode: false,
    };
    let learner = GpuLearner::new(share, &plan, &parameters)?;
    Ok((learner, (0..count as u32).collect()))
}

impl GpuReport {
    /// The table.
    pub fn print(&self) {
        rcwm_models::outln!(
            "{} on {}, {}: batch {} x {}, imagination {}; {} learners{}; {} updates; prepared in {:.0} ms; memory {:.0} MB",
            self.name,
            self.card,
            self.precision,
            self.batch,
            self.length,
            self.horizon,
            self.together,
            if self.apart { " with programs of their own" } else { "" },
            self.updates,
            self.prepare_ms,
            self.memory_mbyte,
        );
        rcwm_models::outln!(
            "  replayed: world model {:.2} ms (90 %: {:.2}), {} commands; behaviour {:.2} ms (90 %: {:.2}), {} commands; \
             {:.1} updates of the world model a second",
            self.world_median_ms,
            self.world_p90_ms,
            self.world_commands,
            self.behaviour_median_ms,
            self.behaviour_p90_ms,
            self.behaviour_commands,
            self.world_updates_per_s,
        );
        rcwm_models::outln!(
            "  {:10} {:10} {:>9} {:>9} {:>10} {:>9}",
            "program",
            "part",
            "commands",
            "ms",
            "GFLOP",
            "TFLOP/s"
        );
        for part in &self.parts {
            rcwm_models::outln!(
                "  {:10} {:10} {:>9} {:>9.2} {:>10.2} {:>9.2}",
                part.program,
                part.part,
                part.commands,
                part.ms,
                part.gflop,
                part.tflops_per_s
            );
        }
        for row in &self.dearest {
            rcwm_models::outln!(
                "  {:10} {:10} {:40} {:>6} x {:>9.2} us = {:>7.2} ms",
                row.program,
                row.part,
                row.name,
                row.count,
                row.us,
                row.all_ms
            );
        }
        rcwm_models::outln!();
    }
}
