//! The exported parts as they are, one after another once the image is there: what any ONNX engine can do.
//!
//! Each branch is one part with prior and posterior in it, so that nothing can be worked ahead.

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::wire::ActionValues;

use super::parts::Parts;
use super::tick::{Tick, Work};
use super::{Inputs, PolicyError};
use crate::engine::{EngineError, EngineSettings};

/// The five parts of a tick and the action before it.
pub(super) struct Sequential {
    parts: Parts,
    action: ActionValues,
    /// What was measured last.
    state: Vec<f32>,
}

impl Sequential {
    pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, EngineError> {
        let model = &bundle.manifest.model;
        let (action, state) = (ActionValues::zeros(model.action), vec![0.0; model.state]);
        Ok(Self { parts: Parts::load(bundle, settings)?, action, state })
    }

    fn branches(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Work { state, noise, buffers, clock } = work;
        self.parts.run_robot(&state.robot, &self.action, &self.state, noise.robot(), buffers)?;
        clock.ended(PartName::Robot);
        self.parts.run_interaction(&state.environment, buffers)?;
        clock.ended(PartName::Interaction);
        self.parts.run_environment(&state.environment, noise.environment(), buffers)?;
        clock.ended(PartName::Environment);
        Ok(())
    }

    fn act(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        self.parts.run_actor(work.buffers)?;
        work.clock.ended(PartName::Actor);
        Ok(())
    }
}

impl Tick for Sequential {
    /// Remembers the action: all else waits for the image.
    fn work_ahead(&mut self, action: &ActionValues, _: &mut Work<'_>) -> Result<(), PolicyError> {
        self.action = *action;
        Ok(())
    }

    fn observe(&mut self, inputs: Inputs<'_>, work: &mut Work<'_>) -> Result<(), PolicyError> {
        self.state.clear();
        self.state.extend_from_slice(inputs.state);
        self.parts.run_encoder(inputs.image, work.buffers)?;
        work.clock.ended(PartName::Encoder);
        self.branches(work)?;
        self.act(work)
    }

    /// The branches run on the features of the last image; what they make of them is not used.
    fn imagine(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        self.branches(work)?;
        work.buffers.believe_prior();
        self.act(work)
    }
}
