//! How a tick is computed: the exported parts one after another, or the compiled tick.

use rcwm_models::wire::ActionValues;

use super::noise::NoiseSource;
use super::stages::StageClock;
use super::{Buffers, Inputs, PolicyError, State};

/// What a tick works on. What is computed is left in the buffers; the state is the caller's.
pub(super) struct Work<'a> {
    pub(super) state: &'a State,
    pub(super) noise: &'a NoiseSource,
    pub(super) buffers: &'a mut Buffers,
    pub(super) clock: &'a mut StageClock,
}

/// The three things a tick is made of.
pub(super) trait Tick: Send {
    /// All that needs only the action.
    fn work_ahead(&mut self, action: &ActionValues, work: &mut Work<'_>) -> Result<(), PolicyError>;

    /// All else, once the inputs are there; they are of the bundle's sizes.
    fn observe(&mut self, inputs: Inputs<'_>, work: &mut Work<'_>) -> Result<(), PolicyError>;

    /// All else without an image: the prior stands in for the posterior.
    fn imagine(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError>;

    /// An image may come at any moment: a second thread is to look for work.
    fn wake(&self) {}

    /// An image will come soon: what [`Self::observe`] does is done once with what is there, for the sake of the caches. Changes nothing that
    /// is read later.
    fn warm_caches(&mut self) {}
}
