//! The exported parts as they are, one after another once the image is there: what any ONNX engine can do.
//!
//! Each branch is one part with prior and posterior in it, so that nothing can be worked ahead.

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::wire::ActionValues;

use super::parts::Parts;
use super::tick::{Tick, Work};
use super::{Inputs, PolicyError};
use crate::engine::{EngineError, EngineSettings};

/// The parts of a tick and the action before it.
pub(super) struct Sequential {
    parts: Parts,
    action: ActionValues,
    /// What was measured last.
    state: Vec<f32>,
}

impl Sequential {
    pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, EngineError> {
        let manifest = &bundle.manifest;
        let action = ActionValues::zeros(manifest.interface.action_numbers());
        let state = vec![0.0; manifest.measured_numbers()];
        Ok(Self { parts: Parts::load(bundle, settings)?, action, state })
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
        self.parts.run_branches(&self.action, &self.state, work)?;
        self.act(work)
    }

    /// The branches run on the features of the last image; what they make of them is not used.
    fn imagine(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        self.parts.run_branches(&self.action, &self.state, work)?;
        work.buffers.believe_prior();
        self.act(work)
    }
}
