use candle_core::{Result, Tensor};

use crate::model::branch::Branch;
use crate::model::latent::{Latent, Sampler, State};
use crate::model::rcwm::{ENVIRONMENT, ROBOT, Rcwm};
use crate::model::world::World;

/// The posterior states [K, ...] after `images` (u8 [K, 64, 64, 3]), from the states before them and the actions that led there
/// [K, action]: one step of [`World::observe`] whose carried state is given.
pub fn filter_step(
    world: &World,
    previous: &State,
    images: &Tensor,
    actions: &Tensor,
    sampler: &mut Sampler,
) -> Result<State> {
    let embeds = world.encode(&images.unsqueeze(1)?, None)?; // [K, 1, E] per branch
    let embeds = embeds.iter().map(|embed| embed.squeeze(1)).collect::<Result<Vec<_>>>()?;
    match world {
        World::Rcwm(model) => rcwm_step(model, previous, &embeds, actions, sampler),
        World::Vanilla(model) => {
            let h = model.recur(&previous.branches[0], actions)?;
            Ok(State { branches: vec![posterior(&model.branch, &h, &embeds[0], sampler)?] })
        }
    }
}

fn rcwm_step(
    model: &Rcwm,
    previous: &State,
    embeds: &[Tensor],
    actions: &Tensor,
    sampler: &mut Sampler,
) -> Result<State> {
    let [robot, environment] = &model.branches;
    let robot_h = model.recur_robot(&previous.branches[ROBOT], actions)?;
    let prior = robot.draw(robot.prior_logits(&robot_h)?, &robot_h, sampler)?;
    let robot_posterior = posterior(robot, &robot_h, &embeds[ROBOT], sampler)?;
    let before = &previous.branches[ENVIRONMENT];
    let (e, _) = model.interaction.forward(&prior.z, &robot_h, &before.z)?;
    let environment_h = model.recur_environment(&e, &before.h)?;
    let environment_posterior = posterior(environment, &environment_h, &embeds[ENVIRONMENT], sampler)?;
    Ok(State { branches: vec![robot_posterior, environment_posterior] })
}

fn posterior(branch: &Branch, h: &Tensor, embed: &Tensor, sampler: &mut Sampler) -> Result<Latent> {
    let logits = branch.posterior_logits(h, &branch.embed_share(embed)?)?;
    branch.draw(logits, h, sampler)
}
