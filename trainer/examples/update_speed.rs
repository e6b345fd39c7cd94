//! Time of the world model's forward pass by part, and of its backward pass: medians.
//!
//! ```text
//! cargo run --release -p rcwm-trainer --example update_speed -- [repetitions] [batch] [length] [small | paper]
//! ```
//!
//! The losses are the picture's, the reward's and the divergences', so that every part gets its gradient.

use std::time::Instant;

use anyhow::{Result, bail};
use candle_core::{D, DType, Device, Tensor};
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_trainer::behaviour::{self, Horizon};
use rcwm_trainer::model::agent::{self, Agent};
use rcwm_trainer::model::latent::{FirstSteps, Sampler, State};
use rcwm_trainer::ops::{self, Adam, AdamSettings, KlBalance};

/// Seconds of each part of a run, in order.
#[derive(Default)]
struct Clock {
    parts: Vec<(&'static str, f64)>,
}

impl Clock {
    fn time<T, E>(&mut self, part: &'static str, body: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
        let start = Instant::now();
        let result = body();
        self.parts.push((part, start.elapsed().as_secs_f64()));
        result
    }
}

struct Batch {
    images: Tensor,
    actions: Tensor,
    first: FirstSteps,
}

impl Batch {
    fn new(batch: usize, length: usize) -> Result<Self> {
        let count = batch * length * 64 * 64 * 3;
        let bytes: Vec<u8> = (0..count).map(|i| (i / 7 % 251) as u8).collect();
        let images = Tensor::from_vec(bytes, (batch, length, 64, 64, 3), &Device::Cpu)?;
        let values: Vec<f32> = (0..batch * length * 4).map(|i| (i % 19) as f32 / 10.0 - 0.9).collect();
        let actions = Tensor::from_vec(values, (batch, length, 4), &Device::Cpu)?;
        let flags = (0..batch * length).map(|i| i % (length + 5) == 11).collect();
        Ok(Self { images, actions, first: FirstSteps::new(flags, length) })
    }
}

fn world(agent: &Agent, batch: &Batch, adam: &mut Adam, clock: &mut Clock) -> Result<State> {
    let mut sampler = Sampler::seeded(1);
    let balance = KlBalance { free: 1.0, prior_scale: 0.5, posterior_scale: 0.1 };
    let embeds = clock.time("encode", || agent.world.encode(&batch.images))?;
    let observed =
        clock.time("observe", || agent.world.observe(&embeds, &batch.actions, &batch.first, &mut sampler))?;
    let painted =
        clock.time("decode", || agent.world.picture_loss(&observed.posteriors, &batch.images, None))?;
    let loss = clock.time("losses", || -> candle_core::Result<Tensor> {
        let mut loss = painted.0.sum_all()?;
        for (posterior, prior) in observed.posteriors.branches.iter().zip(&observed.priors.branches) {
            let unimix = agent.settings.unimix;
            loss =
                (loss + ops::balanced_kl(&posterior.logits, &prior.logits, unimix, balance)?.0.sum_all()?)?;
        }
        let features = observed.posteriors.features()?;
        let reward = agent.heads.reward.logits(&features)?;
        let bins = ops::bins_tensor(agent.settings.bins, &Device::Cpu)?;
        let targets = Tensor::zeros(&reward.dims()[..2], DType::F32, &Device::Cpu)?;
        loss + ops::two_hot_loss(&reward, &bins, &targets)?.sum_all()?
    })?;
    let grads = clock.time("backward", || loss.backward())?;
    clock.time("adam", || adam.update(&grads))?;
    let alone = observed.posteriors.map(|x| Ok(x.detach()))?;
    let loss = agent.world.picture_loss(&alone, &batch.images, None)?.0.sum_all()?;
    clock.time("(of the decoders)", || loss.backward())?;
    let loss = (embeds[0].sqr()?.mean_all()? + embeds[1].sqr()?.mean_all()?)?;
    clock.time("(of the encoders)", || loss.backward())?;
    let rows = |x: &Tensor| x.detach().flatten(0, 1);
    Ok(observed.posteriors.map(rows)?)
}

fn behave(agent: &Agent, start: &State, clock: &mut Clock) -> Result<()> {
    let mut sampler = Sampler::seeded(2);
    let imagined =
        clock.time("imagine", || behaviour::imagine(agent, start, &Horizon::default(), &mut sampler))?;
    let loss = imagined.returns.mean_all()?.neg()?;
    clock.time("actor backward", || loss.backward())?;
    Ok(())
}

fn main() -> Result<()> {
    ops::leave_threads_to_ops();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: usize| arguments.get(index).map_or(Ok(default), |text| text.parse());
    let (repetitions, batch, length) = (number(0, 5)?, number(1, 8)?, number(2, 32)?);
    let preset = match arguments.get(3).map(String::as_str) {
        None | Some("small") => Preset::Small,
        Some("paper") => Preset::Paper,
        Some(other) => bail!("unknown size {other}: small or paper"),
    };
    let settings = ModelSettings::preset(preset, ModelKind::Rcwm);
    let parameters = agent::initialise(&settings, 1, &Device::Cpu)?;
    let agent = Agent::new(&parameters.trainable(), &settings)?;
    let frozen = Agent::new(&parameters.frozen(), &settings)?;
    let mixed = Agent { actor: agent.actor.clone(), ..frozen };
    let variables = parameters.iter().map(|(name, var)| (name.to_owned(), var.clone()));
    let mut adam = Adam::new(variables, AdamSettings { clip: Some(1000.0), ..AdamSettings::new(1e-4) })?;
    let data = Batch::new(batch, length)?;
    let mut runs = Vec::new();
    for _ in 0..repetitions {
        let mut clock = Clock::default();
        let start = world(&agent, &data, &mut adam, &mut clock)?;
        behave(&mixed, &start, &mut clock)?;
        runs.push(clock.parts);
    }
    println!(
        "{:?}, batch {batch} x {length}, latents {}, width {}",
        preset,
        settings.stoch_width(),
        start_width(&agent)?
    );
    for (index, (part, _)) in runs[0].iter().enumerate() {
        let mut times: Vec<f64> = runs.iter().map(|run| run[index].1).collect();
        times.sort_by(f64::total_cmp);
        println!("{part:16} {:9.2} ms (least {:.2})", 1e3 * times[times.len() / 2], 1e3 * times[0]);
    }
    Ok(())
}

fn start_width(agent: &Agent) -> Result<usize> {
    Ok(agent.world.initial(1)?.features()?.dim(D::Minus1)?)
}
