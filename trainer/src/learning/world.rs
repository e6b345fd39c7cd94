use std::ops::Range;

use candle_core::Tensor;
use rcwm_models::settings::ModelSettings;

use super::parts::part;
use super::{
    Adam, Batch, Gradients, LearningError, LossValues, Side, Trained, WorldLosses, WorldSettings, side_of,
    world_losses,
};
use super::{CloningLoss, Examples, cloning_loss};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};
use crate::model::parameters::Parameters;
use crate::ops;

/// The world model with what it takes to train it.
#[derive(Debug, Clone)]
pub struct WorldLearner {
    agent: Agent,
    parameters: Parameters,
    trained: Trained,
    settings: WorldSettings,
    imitation: Option<Imitation>,
    adam: Adam,
}

/// The actor's part in the world model's loss: what a demonstrated action depends on is worth representing, however few its pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Imitation {
    /// Factor of the distance from the demonstrated actions.
    pub scale: f64,
    /// What the distance is.
    pub loss: CloningLoss,
    /// Learning rate of the actor.
    pub learning_rate: f64,
}

/// What one update of the world model was.
#[derive(Debug, Clone)]
pub struct WorldUpdate {
    /// The losses before it.
    pub losses: LossValues,
    /// Norm of the gradients before clipping.
    pub gradient_norm: f64,
    /// The batch's posterior states [B, T, ...], without gradient: where imagination starts.
    pub posteriors: State,
}

impl WorldLearner {
    /// A learner that trains this part of `parameters`, which it shares.
    ///
    /// # Errors
    /// If the parameters do not fit the model.
    pub fn new(
        parameters: &Parameters,
        model: &ModelSettings,
        settings: &WorldSettings,
        trained: Trained,
    ) -> Result<Self, LearningError> {
        let adam = Adam::new(settings.adam.clone());
        let agent = Agent::new(&parameters.trainable_where(trained.filter()), model)?;
        Ok(Self {
            agent,
            parameters: parameters.clone(),
            trained,
            settings: settings.clone(),
            imitation: None,
            adam,
        })
    }

    /// Trains another part from now on; the optimiser goes on. The actor is only among what is trained together with an `imitation`.
    ///
    /// # Errors
    /// If the parameters do not fit the model.
    pub fn train(&mut self, trained: Trained, imitation: Option<Imitation>) -> Result<(), LearningError> {
        self.imitation = imitation;
        self.agent = Agent::new(&self.parameters.trainable_where(trained.filter()), &self.agent.settings)?;
        self.trained = trained;
        Ok(())
    }

    /// The optimiser.
    #[must_use]
    pub fn adam(&self) -> &Adam {
        &self.adam
    }

    /// The optimiser, to be replaced by a resumed one.
    pub fn adam_mut(&mut self) -> &mut Adam {
        &mut self.adam
    }

    /// The losses of a batch, with the graph they are differentiated through.
    pub fn losses(&self, batch: &Batch, sampler: &mut Sampler) -> candle_core::Result<WorldLosses> {
        self.losses_of_share(batch, examples_a_row(batch), sampler)
    }

    /// The losses of some rows of a batch that has so many examples a row: a share counts by its rows, but the rows differ in examples.
    /// So the cloning loss is scaled such that the shares' losses, by their rows, add up to the mean over all examples of the batch.
    fn losses_of_share(
        &self,
        batch: &Batch,
        in_whole: f64,
        sampler: &mut Sampler,
    ) -> candle_core::Result<WorldLosses> {
        let mut losses = world_losses(&self.agent, batch, &self.settings, sampler)?;
        if let Some(imitation) = &self.imitation {
            let features = losses.observed.posteriors.features()?; // [B, T, state width]
            let here = examples_a_row(batch);
            let (features, actions, scale) = if here > 0.0 {
                let (features, actions) = Examples::of_batch(&features, batch)?;
                (features, actions, here / in_whole)
            } else {
                // Rows without an example: the actor's gradient is there all the same, and zero.
                let first = |x: &Tensor| x.flatten(0, 1)?.narrow(0, 0, 1);
                (first(&features)?, first(&batch.action)?, 0.0)
            };
            let loss = cloning_loss(&self.agent.actor, &features, &actions, imitation.loss)?;
            // As a tensor: candle lets no gradient through a factor that is the number 0.
            let loss = loss.mul(&Tensor::new(scale as f32, loss.device())?)?;
            losses.total = (&losses.total + (&loss * imitation.scale)?)?;
            losses.cloning = Some(loss);
        }
        Ok(losses)
    }

    /// The losses of a batch, without their graph, and the gradients of the total in what is trained.
    ///
    /// The threads share the sequences among themselves, and each goes its whole way forth and back alone: in the scan over
    /// time there is too little to do at once for threads to help each other.
    ///
    /// # Errors
    /// See [`Gradients::of`].
    pub fn gradients(
        &self,
        batch: &Batch,
        sampler: &mut Sampler,
    ) -> Result<(WorldLosses, Gradients), LearningError> {
        let (rows, whole, examples) = (batch.first.batch(), &*sampler, examples_a_row(batch));
        let share = |rows_here: Range<usize>| {
            let mut sampler = whole.share(rows_here.clone(), rows);
            let weight = rows_here.len() as f64 / rows as f64;
            let losses = self.losses_of_share(&batch.rows(&rows_here)?, examples, &mut sampler)?;
            let gradients = part("world backward", || {
                Gradients::of_share(&(&losses.total * weight)?, &self.parameters, self.trained.filter())
            })?;
            Ok::<_, LearningError>(((weight, losses.detached()), gradients, sampler))
        };
        let shares = ops::in_parallel(ops::shares_of(rows, batch.image.device()), share);
        let (mut losses, mut gradients) = (Vec::new(), Vec::new());
        let mut followed = None;
        for share in shares {
            let (share_losses, share_gradients, share_sampler) = share?;
            losses.push(share_losses);
            gradients.push(share_gradients);
            followed = Some(share_sampler);
        }
        followed.into_iter().for_each(|share| sampler.follow(share));
        part("world sum", || Ok((WorldLosses::merged(&losses)?, Gradients::sum(gradients)?)))
    }

    /// Moves the parameters.
    pub fn apply(&mut self, gradients: &Gradients) -> candle_core::Result<()> {
        let rate = self.settings.adam.learning_rate;
        let environment = self.settings.environment_learning_rate;
        self.adam.step_at(&self.parameters, gradients, |name| match side_of(name) {
            Side::Environment if environment > 0.0 => environment,
            Side::Actor => self.imitation.map_or(rate, |imitation| imitation.learning_rate),
            _ => rate,
        })
    }

    /// One update from one batch.
    ///
    /// # Errors
    /// See [`LearningError`]; the parameters are then as they were.
    pub fn update(&mut self, batch: &Batch, sampler: &mut Sampler) -> Result<WorldUpdate, LearningError> {
        let (losses, gradients) = self.gradients(batch, sampler)?;
        part("world Adam", || self.apply(&gradients))?;
        Ok(WorldUpdate {
            losses: losses.values()?,
            gradient_norm: gradients.norm(),
            posteriors: losses.observed.posteriors,
        })
    }
}

/// Examples of a batch for the actor, by its rows.
fn examples_a_row(batch: &Batch) -> f64 {
    Examples::places_in(batch).len() as f64 / batch.first.batch().max(1) as f64
}
