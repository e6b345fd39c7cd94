use rcwm_models::settings::ModelSettings;

use super::parts::part;
use super::{
    Adam, Batch, Gradients, LearningError, LossValues, Side, Trained, WorldLosses, WorldSettings, side_of,
    world_losses,
};
use crate::model::agent::Agent;
use crate::model::latent::{Sampler, State};
use crate::model::parameters::Parameters;

/// The world model with what it takes to train it.
#[derive(Debug, Clone)]
pub struct WorldLearner {
    agent: Agent,
    parameters: Parameters,
    trained: Trained,
    settings: WorldSettings,
    adam: Adam,
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
        Ok(Self { agent, parameters: parameters.clone(), trained, settings: settings.clone(), adam })
    }

    /// Trains another part from now on; the optimiser goes on.
    ///
    /// # Errors
    /// If the parameters do not fit the model.
    pub fn train(&mut self, trained: Trained) -> Result<(), LearningError> {
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
    ///
    /// # Errors
    /// Those of candle.
    pub fn losses(&self, batch: &Batch, sampler: &mut Sampler) -> candle_core::Result<WorldLosses> {
        world_losses(&self.agent, batch, &self.settings, sampler)
    }

    /// Gradients of the total loss in what is trained.
    ///
    /// # Errors
    /// See [`Gradients::of`].
    pub fn gradients(&self, losses: &WorldLosses) -> Result<Gradients, LearningError> {
        Gradients::of(&losses.total, &self.parameters, self.trained.filter())
    }

    /// Moves the parameters.
    ///
    /// # Errors
    /// Those of candle.
    pub fn apply(&mut self, gradients: &Gradients) -> candle_core::Result<()> {
        let rate = self.settings.adam.learning_rate;
        let environment = self.settings.environment_learning_rate;
        self.adam.step_at(&self.parameters, gradients, |name| match side_of(name) {
            Side::Environment if environment > 0.0 => environment,
            _ => rate,
        })
    }

    /// One update from one batch.
    ///
    /// # Errors
    /// See [`LearningError`]; the parameters are then as they were.
    pub fn update(&mut self, batch: &Batch, sampler: &mut Sampler) -> Result<WorldUpdate, LearningError> {
        let losses = self.losses(batch, sampler)?;
        let gradients = part("world backward", || self.gradients(&losses))?;
        part("world Adam", || self.apply(&gradients))?;
        Ok(WorldUpdate {
            losses: losses.values()?,
            gradient_norm: gradients.norm(),
            posteriors: losses.observed.posteriors.map(|x| Ok(x.detach()))?,
        })
    }
}
