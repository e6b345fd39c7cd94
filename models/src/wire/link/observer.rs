//! Listening in: a recorder's or a monitor's end, beside the controller.

use std::time::Duration;

use iceoryx2::prelude::Node;

use super::direction::{Direction, Received, Receiver};
use super::domain::make_node;
use super::{Ipc, LinkError, LinkSettings, Wait};
use crate::wire::Observation;

/// Receives observations without taking part: nobody waits for it, and it sees the newest only.
pub struct ObserverLink {
    settings: LinkSettings,
    observations: Receiver<Observation>,
    // Dropped last: the port above belongs to it.
    _node: Node<Ipc>,
}

impl ObserverLink {
    /// Opens or creates the observation service of an instance.
    ///
    /// # Errors
    /// See [`LinkError`].
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        let node = make_node(&settings)?;
        let observations =
            Direction::<Observation>::open(&node, &settings.instance, "observation")?.receiver()?;
        Ok(Self { settings, observations, _node: node })
    }

    /// Waits for the next observation; [`Wait::Closed`] when the simulator has said that none will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_observation(&self, timeout: Duration) -> Result<Wait<Received<Observation>>, LinkError> {
        Ok(self.observations.wait(self.settings.spin, timeout)?.0)
    }
}
