use candle_core::Device;

use super::compute::WorldUpdates;
use super::{ReplaySettings, TrainingError};
use crate::learning::{LossValues, WorldSettings, world_losses};
use crate::model::agent::Agent;
use crate::model::latent::Sampler;
use crate::replay::Replay;

/// What sets these batches apart from those that are trained on under the same seed.
const STREAM: u64 = 0x0068_656c_646f_7574;

/// Episodes that are not trained on, and the batches that are drawn of them.
#[derive(Debug)]
pub(super) struct HeldOut {
    /// The episodes.
    pub replay: Replay,
    seed: u64,
}

impl HeldOut {
    pub(super) fn new(replay: Replay, seed: u64) -> Self {
        Self { replay, seed: seed ^ STREAM }
    }

    /// Mean mask-free losses of a frozen agent over batches and noise that are the same every time; none where nothing is held out.
    ///
    /// # Errors
    /// Those of drawing and of candle.
    pub(super) fn losses(
        &self,
        agent: &Agent,
        sizes: &ReplaySettings,
        world: &WorldSettings,
        device: &Device,
        updates: &mut WorldUpdates,
    ) -> Result<Option<LossValues>, TrainingError> {
        if self.replay.episodes() == 0 {
            return Ok(None);
        }
        let mut found = Vec::with_capacity(sizes.held_out_batches);
        for number in 0..sizes.held_out_batches as u64 {
            let batch = self.replay.draw(sizes.batch, sizes.length, false, self.seed, number)?;
            if let Some(losses) = updates.validate(&batch, self.seed, number)? {
                found.push(losses);
                continue;
            }
            let mut sampler = Sampler::numbered(self.seed, number);
            found.push(world_losses(agent, &batch.into_tensors(device)?, world, &mut sampler)?.values()?);
        }
        Ok(Some(mean_losses(&found)))
    }
}

/// Means of the losses; of those that are not always there, over the updates that have them.
pub(super) fn mean_losses(losses: &[LossValues]) -> LossValues {
    let mean = |value: fn(&LossValues) -> Option<f64>| {
        let values: Vec<f64> = losses.iter().filter_map(value).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    LossValues {
        total: mean(|losses| Some(losses.total)).unwrap_or_default(),
        image: mean(|losses| Some(losses.image)).unwrap_or_default(),
        robot_mask: mean(|losses| losses.robot_mask),
        state: mean(|losses| losses.state),
        cloning: mean(|losses| losses.cloning),
        reward: mean(|losses| Some(losses.reward)).unwrap_or_default(),
        continues: mean(|losses| Some(losses.continues)).unwrap_or_default(),
        robot_kl: mean(|losses| Some(losses.robot_kl)).unwrap_or_default(),
        environment_kl: mean(|losses| losses.environment_kl),
    }
}
