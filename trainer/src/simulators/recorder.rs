use std::sync::atomic::AtomicBool;

use rcwm_models::episode::{Episode, EpisodeBuilder};
use rcwm_models::wire::{ActionValues, Format, ObservationFlags};

use super::{Client, CollectError};

/// An episode that was seen from its first to its last observation.
#[derive(Debug)]
pub(super) struct Recorded {
    /// Its number on the wire.
    pub number: u64,
    /// The task's number on the wire.
    pub task: u32,
    /// All of it.
    pub episode: Episode,
}

/// Puts the observations of a simulator together into episodes.
pub(super) struct Recorder {
    client: Client,
    builder: EpisodeBuilder,
}

impl Recorder {
    pub(super) fn new(client: Client) -> Self {
        Self { client, builder: EpisodeBuilder::new() }
    }

    /// The next whole episode, every observation answered by what `decide` says, in units; `None` when the simulator is done or `stop` was
    /// set. One that was joined in its middle is let pass.
    pub(super) fn episode(
        &mut self,
        stop: &AtomicBool,
        mut decide: impl FnMut(&Format) -> ActionValues,
        step: impl Fn(),
    ) -> Result<Option<Recorded>, CollectError> {
        while let Some(observation) = self.client.next(stop)? {
            if observation.is(ObservationFlags::FIRST) {
                self.builder = EpisodeBuilder::new();
            }
            if observation.is(ObservationFlags::FIRST) || !self.builder.is_empty() {
                self.builder.push(&observation.view())?;
                step();
            }
            self.client.answer(observation.sequence, decide(observation.view().format()))?;
            if !observation.is(ObservationFlags::LAST) {
                continue;
            }
            if let Some(episode) = self.builder.finish() {
                return Ok(Some(Recorded { number: observation.episode, task: observation.task, episode }));
            }
        }
        Ok(None)
    }
}
