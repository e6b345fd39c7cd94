//! How a tick is computed: the exported parts one after another, or the compiled tick.

use rcwm_models::ACTION_LEN;
use rcwm_models::bundle::Bundle;

use super::compiled::Compiled;
use super::noise::NoiseSource;
use super::sequential::Sequential;
use super::stages::StageClock;
use super::{Buffers, PolicyError, State};
use crate::engine::{EngineSettings, Form};

/// The three things a tick is made of. What is computed is left in the buffers; the state is the caller's.
pub(super) trait Tick: Send {
    /// All that needs only the action.
    fn work_ahead(
        &mut self,
        state: &State,
        action: &[f32; ACTION_LEN],
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError>;

    /// All else, once the image is there.
    fn observe(
        &mut self,
        image: &[u8],
        state: &State,
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError>;

    /// All else without an image: the prior stands in for the posterior.
    fn imagine(
        &mut self,
        state: &State,
        noise: &NoiseSource,
        buffers: &mut Buffers,
        clock: &mut StageClock,
    ) -> Result<(), PolicyError>;

    /// An image is about to come.
    fn wake(&self) {}
}

pub(super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Box<dyn Tick>, PolicyError> {
    Ok(match settings.form {
        Form::Exported => Box::new(Sequential::load(bundle, settings)?),
        Form::Compiled(optimizations) => Box::new(Compiled::load(bundle, optimizations, settings.threads)?),
    })
}
