use candle_core::{Result, Tensor};

use crate::learning::Batch;
use crate::model::latent::{FirstSteps, Latent, Sampler, State};
use crate::model::world::World;

/// Posterior states of the first `context` steps, then states imagined with the recorded actions from the last of them: every
/// tensor [B, T, ...]. Only the context's images are looked at.
pub fn open_loop(world: &World, batch: &Batch, context: usize, sampler: &mut Sampler) -> Result<State> {
    let context = context.clamp(1, batch.first.length());
    let seen = filtered(world, batch, context, sampler)?;
    if context == batch.first.length() {
        return Ok(seen);
    }
    let imagined = imagined(world, batch, &seen, context, sampler)?;
    joined(&seen, &imagined)
}

/// Posterior states of the first `steps` steps, [B, steps, ...]; every sequence begins an episode for the model.
pub fn filtered(world: &World, batch: &Batch, steps: usize, sampler: &mut Sampler) -> Result<State> {
    let rows = batch.first.batch();
    let part = |x: &Tensor| x.narrow(1, 0, steps)?.contiguous();
    let state = batch.state.as_ref().map(part).transpose()?;
    let embeds = world.encode(&part(&batch.image)?, state.as_ref())?;
    let first = FirstSteps::new((0..rows * steps).map(|index| index % steps == 0).collect(), steps);
    let actions = batch.action.narrow(1, 0, steps)?;
    Ok(world.observe(&embeds, &actions, &first, sampler)?.posteriors)
}

/// States imagined with the recorded actions of the steps from `context` on, [B, T - context, ...], from the posterior
/// state before them. `posteriors` are those of the first `context` steps or more.
pub fn imagined(
    world: &World,
    batch: &Batch,
    posteriors: &State,
    context: usize,
    sampler: &mut Sampler,
) -> Result<State> {
    let start = posteriors.map(|x| x.narrow(1, context - 1, 1)?.squeeze(1)?.contiguous())?;
    let actions = batch.action.narrow(1, context, batch.first.length() - context)?;
    world.imagine(&start, &actions, sampler)
}

/// Two stretches of states [B, ..., ...] after each other.
pub fn joined(before: &State, after: &State) -> Result<State> {
    let join = |a: &Tensor, b: &Tensor| Tensor::cat(&[a, b], 1);
    let branches = before.branches.iter().zip(&after.branches).map(|(a, b)| {
        Ok(Latent { z: join(&a.z, &b.z)?, h: join(&a.h, &b.h)?, logits: join(&a.logits, &b.logits)? })
    });
    Ok(State { branches: branches.collect::<Result<_>>()? })
}
