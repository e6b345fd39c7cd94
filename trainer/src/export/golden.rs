//! Golden values: some ticks of inputs, and what the model makes of them in candle, recurrently.

use std::collections::BTreeMap;

use candle_core::{D, DType, Device, Tensor};
use ndarray::{ArrayD, IxDyn};
use rcwm_models::bundle::{InitialBranch, InitialState, PartName};
use rcwm_models::tensors::{Tensors, Values};

use super::scene::Scene;
use super::{ExportError, Progress};
use crate::model::agent::Agent;
use crate::model::branch::Branch;
use crate::model::latent::{Latent, Sampler, State};
use crate::model::rcwm::{ENVIRONMENT, ROBOT, Rcwm};
use crate::model::vanilla::Vanilla;
use crate::model::world::World;
use crate::ops;

/// Ticks for which the large outputs (features, pictures) are kept.
const LARGE_TICKS: usize = 2;

/// Noise is drawn again where the two best classes of a categorical are closer than this: which of them wins would otherwise
/// depend on rounding.
const MARGIN_MIN: f32 = 1e-3;
/// Draws before a narrow margin is accepted after all.
const DRAWS_MAX: usize = 100;

/// Runs the policy over the scene and writes down every part's inputs and outputs.
pub fn record(
    agent: &Agent,
    parts: &[PartName],
    scene: &Scene,
    seed: u64,
    progress: &dyn Progress,
) -> Result<Tensors, ExportError> {
    let mut recorder = Recorder { agent, parts, rows: BTreeMap::new(), sampler: Sampler::seeded(seed) };
    let initial = agent.world.initial(1)?;
    let mut state = initial.clone();
    for tick in 0..scene.len() {
        progress.step("golden tick", tick, scene.len())?;
        if scene.is_first(tick) {
            state = initial.clone();
        }
        state = recorder.tick(&state, scene, tick)?;
    }
    recorder.finish(scene)
}

/// The learned state an episode starts from, as the runtime keeps it.
pub fn initial_state(agent: &Agent) -> Result<InitialState, ExportError> {
    let state = agent.world.initial(1)?;
    let branch = |latent: &Latent| -> Result<InitialBranch, ExportError> {
        let h = latent.h.flatten_all()?.to_vec1::<f32>()?;
        Ok(InitialBranch { h, z: classes(&latent.z)?.flatten_all()?.to_vec1::<i64>()? })
    };
    Ok(InitialState { branches: state.branches.iter().map(branch).collect::<Result<_, _>>()? })
}

/// What one branch made of a tick.
struct Drawn {
    h: Tensor,
    prior: Latent,
    posterior: Latent,
}

struct Recorder<'a> {
    agent: &'a Agent,
    parts: &'a [PartName],
    rows: BTreeMap<String, Vec<Tensor>>,
    sampler: Sampler,
}

impl Recorder<'_> {
    /// One tick; gives the posterior state.
    fn tick(&mut self, before: &State, scene: &Scene, tick: usize) -> Result<State, ExportError> {
        let agent = self.agent;
        let branches = match &agent.world {
            World::Rcwm(world) => self.rcwm(world, before, scene, tick)?,
            World::Vanilla(world) => self.vanilla(world, before, scene, tick)?,
        };
        // One-hot rows exactly, as the runtime carries class indices.
        let state = State { branches }.map(|x| Ok(x.detach()))?;
        self.heads(&state)?;
        if tick < LARGE_TICKS {
            self.pictures(&state)?;
        }
        Ok(state)
    }

    /// The posteriors of both branches.
    fn rcwm(
        &mut self,
        world: &Rcwm,
        before: &State,
        scene: &Scene,
        tick: usize,
    ) -> Result<Vec<Latent>, ExportError> {
        let features = world.features(&scene.image(tick)?)?; // [1, S/4, S/4, 2c]
        self.features(&features, tick)?;
        let h = world.recur_robot(&before.branches[ROBOT], &scene.action(tick)?)?;
        let embed = world.embed_robot(&features, scene.state(tick)?.as_ref())?;
        let robot = self.branch(PartName::Robot, &world.branches[ROBOT], h, embed)?;

        let environment = &before.branches[ENVIRONMENT];
        let (e, attention) = world.interaction.forward(&robot.prior.z, &robot.h, &environment.z)?;
        self.expect(PartName::Interaction, "e", &e);
        self.expect(PartName::Interaction, "attention", &attention);

        let h = world.recur_environment(&e, &environment.h)?;
        let embed = world.embed(ENVIRONMENT, &features)?;
        let environment = self.branch(PartName::Environment, &world.branches[ENVIRONMENT], h, embed)?;
        Ok(vec![robot.posterior, environment.posterior])
    }

    /// The posterior of the one branch.
    fn vanilla(
        &mut self,
        world: &Vanilla,
        before: &State,
        scene: &Scene,
        tick: usize,
    ) -> Result<Vec<Latent>, ExportError> {
        let features = world.features(&scene.image(tick)?)?; // [1, 4, 4, 8c]
        self.features(&features, tick)?;
        let h = world.recur(&before.branches[0], &scene.action(tick)?)?;
        let embed = world.embed(&features, scene.state(tick)?.as_ref())?;
        Ok(vec![self.branch(PartName::Dynamics, &world.branch, h, embed)?.posterior])
    }

    fn features(&mut self, features: &Tensor, tick: usize) -> Result<(), ExportError> {
        if tick < LARGE_TICKS {
            self.expect(PartName::Encoder, "features", &features.permute((0, 3, 1, 2))?);
        }
        Ok(())
    }

    /// Prior and posterior of a branch whose h' is known.
    fn branch(
        &mut self,
        part: PartName,
        branch: &Branch,
        h: Tensor,
        embed: Tensor,
    ) -> Result<Drawn, ExportError> {
        let unimix = self.agent.settings.unimix;
        let share = branch.embed_share(&embed)?;
        let (prior, posterior) = (branch.prior_logits(&h)?, branch.posterior_logits(&h, &share)?);
        let (prior_log_probs, posterior_log_probs) =
            (ops::log_probs(&prior, unimix)?, ops::log_probs(&posterior, unimix)?);
        let (prior_noise, posterior_noise) =
            (self.noise(&prior_log_probs)?, self.noise(&posterior_log_probs)?);
        let prior = branch.draw_with(prior, &h, Some(&prior_noise))?;
        let posterior = branch.draw_with(posterior, &h, Some(&posterior_noise))?;

        let noise = Tensor::stack(&[prior_noise, posterior_noise], 1)?; // [1, 2, n, m]
        self.rows.entry(format!("input/{part}_noise")).or_default().push(noise);
        self.expect(part, "h_next", &h);
        self.expect(part, "prior_z", &classes(&prior.z)?);
        self.expect(part, "posterior_z", &classes(&posterior.z)?);
        self.expect(part, "prior_log_probs", &prior_log_probs);
        self.expect(part, "posterior_log_probs", &posterior_log_probs);
        Ok(Drawn { h, prior, posterior })
    }

    /// Gumbel noise [1, n, m] that leaves no categorical undecided.
    fn noise(&mut self, log_probs: &Tensor) -> Result<Tensor, ExportError> {
        let mut draws = 1;
        loop {
            let noise = self.sampler.gumbel(log_probs.dims(), log_probs.device())?;
            let noise = noise.map_or_else(|| log_probs.zeros_like(), Ok)?;
            if draws == DRAWS_MAX || smallest_margin(&(log_probs + &noise)?)? >= MARGIN_MIN {
                return Ok(noise);
            }
            draws += 1;
        }
    }

    /// Everything that is read from the state.
    fn heads(&mut self, state: &State) -> Result<(), ExportError> {
        let features = state.features()?; // [1, state width]
        let action = self.agent.actor.forward(&features)?;
        self.expect(PartName::Actor, "mean", &action.mean);
        self.expect(PartName::Actor, "std", &action.std);
        let heads = &self.agent.heads;
        let reward = heads.reward.mean(&heads.reward.logits(&features)?)?;
        let continues = heads.continue_probability(&features)?;
        self.expect(PartName::Reward, "reward", &reward);
        self.expect(PartName::Continue, "continue_probability", &continues);
        Ok(())
    }

    fn pictures(&mut self, state: &State) -> Result<(), ExportError> {
        let decoded = self.agent.world.decode(state)?;
        self.expect(PartName::Decoder, "image", &decoded.image);
        if let World::Vanilla(_) = self.agent.world {
            self.expect(PartName::Decoder, "mask", &decoded.pictures[0].mask);
            return Ok(());
        }
        for (branch, picture) in ["robot", "environment"].iter().zip(&decoded.pictures) {
            self.expect(PartName::Decoder, &format!("{branch}_image"), &picture.masked()?);
            self.expect(PartName::Decoder, &format!("{branch}_mask"), &picture.mask);
        }
        Ok(())
    }

    /// Writes down one tick of an output, if the part is exported.
    fn expect(&mut self, part: PartName, output: &str, value: &Tensor) {
        if self.parts.contains(&part) {
            self.rows.entry(format!("expect/{part}/{output}")).or_default().push(value.clone());
        }
    }

    fn finish(self, scene: &Scene) -> Result<Tensors, ExportError> {
        let mut tensors = scene.inputs()?;
        for (name, rows) in self.rows {
            tensors.0.insert(name, to_values(&Tensor::cat(&rows, 0)?)?);
        }
        Ok(tensors)
    }
}

/// Class indices [..., n] of one-hot rows [..., n, m].
fn classes(z: &Tensor) -> candle_core::Result<Tensor> {
    z.argmax(D::Minus1)?.to_dtype(DType::I64)
}

/// The smallest distance between the best and the second-best class of any categorical.
fn smallest_margin(scores: &Tensor) -> candle_core::Result<f32> {
    let classes = scores.dim(D::Minus1)?;
    let rows = scores.reshape(((), classes))?.to_vec2::<f32>()?;
    let margin = |row: &Vec<f32>| {
        let (best, second) = row.iter().fold((f32::NEG_INFINITY, f32::NEG_INFINITY), |(best, second), x| {
            if *x > best { (*x, best) } else { (best, second.max(*x)) }
        });
        best - second
    };
    Ok(rows.iter().map(margin).fold(f32::INFINITY, f32::min))
}

/// A tensor as a host array.
pub fn to_values(tensor: &Tensor) -> Result<Values, ExportError> {
    let shape = IxDyn(tensor.dims());
    let flat = tensor.to_device(&Device::Cpu)?.flatten_all()?;
    const FITS: &str = "candle gives as many values as the shape holds";
    Ok(match tensor.dtype() {
        DType::I64 => Values::I64(ArrayD::from_shape_vec(shape, flat.to_vec1()?).expect(FITS)),
        DType::U8 => Values::U8(ArrayD::from_shape_vec(shape, flat.to_vec1()?).expect(FITS)),
        _ => Values::F32(ArrayD::from_shape_vec(shape, flat.to_vec1()?).expect(FITS)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_margin_is_that_of_the_least_decided_categorical() {
        let scores = Tensor::new(&[[[3f32, 1.0, 2.5], [0.0, 9.0, -1.0]]], &Device::Cpu).unwrap();
        assert!((smallest_margin(&scores).unwrap() - 0.5).abs() < 1e-6);
    }
}
