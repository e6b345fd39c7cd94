//! The exported parts as they are, one after another once the image is there: what any ONNX engine can do.
//!
//! Each branch is one part with prior and posterior in it, so that nothing can be worked ahead.

use rcwm_models::ACTION_LEN;
use rcwm_models::bundle::{Bundle, PartName};

use super::noise::NoiseSource;
use super::parts::Parts;
use super::stages::StageClock;
use super::tick::Tick;
use super::{Buffers, PolicyError, State};
use crate::engine::{EngineError, EngineSettings};

/// The five parts of a tick and the action before it.
pub(super) struct Sequential {
    parts: Parts,
    action: [f32; ACTION_LEN],
}

impl Sequential {
    pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, EngineError> {
        Ok(Self { parts: Parts::load(bundle, settings)?, action: [0.0; ACTION_LEN] })
    }

    fn branches(
        &mut self,
        state: &State,
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError> {
        self.parts.run_robot(&state.robot, &self.action, noise.robot(), buffers)?;
        clock.ended(PartName::Robot);
        self.parts.run_interaction(&state.environment, buffers)?;
        clock.ended(PartName::Interaction);
        self.parts.run_environment(&state.environment, noise.environment(), buffers)?;
        clock.ended(PartName::Environment);
        Ok(())
    }

    fn act(&mut self, buffers: &mut Buffers, clock: &mut StageClock) -> Result<(), PolicyError> {
        self.parts.run_actor(buffers)?;
        clock.ended(PartName::Actor);
        Ok(())
    }
}

impl Tick for Sequential {
    /// Remembers the action: all else waits for the image.
    fn work_ahead(
        &mut self,
        _: &State,
        action: &[f32; ACTION_LEN],
        _: &NoiseSource,
        _: &mut Buffers,
        _: &mut StageClock,
    ) -> Result<(), PolicyError> {
        self.action = *action;
        Ok(())
    }

    fn observe(
        &mut self,
        image: &[u8],
        state: &State,
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError> {
        self.parts.run_encoder(image, buffers)?;
        clock.ended(PartName::Encoder);
        self.branches(state, noise, buffers, clock)?;
        self.act(buffers, clock)
    }

    /// The branches run on the features of the last image; what they make of them is not used.
    fn imagine(
        &mut self,
        state: &State,
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError> {
        self.branches(state, noise, buffers, clock)?;
        buffers.believe_prior();
        self.act(buffers, clock)
    }
}
