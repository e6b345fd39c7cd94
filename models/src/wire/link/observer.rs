//! Listening in: a recorder's or a monitor's end, beside the controller.

use std::time::Duration;

use iceoryx2::prelude::Node;

use super::direction::{Direction, Received, Receiver};
use super::domain::join;
use super::{Ipc, LinkError, LinkSettings, Wait};
use crate::wire::{Action, Observation};

/// Receives observations without taking part: nobody waits for it, and it sees the newest only.
pub struct ObserverLink {
    settings: LinkSettings,
    observations: Receiver<Observation>,
    // Dropped last: the port above belongs to it.
    _node: Node<Ipc>,
}

impl ObserverLink {
    /// Opens or creates the observation service of an instance.
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        join(&settings.clone(), 0, |node| {
            let observations =
                Direction::<Observation>::open(&node, &settings.instance, "observation")?.receiver()?;
            Ok(Self { settings, observations, _node: node })
        })
    }

    /// Waits for the next observation; [`Wait::Closed`] when the simulator has said that none will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_observation(&self, timeout: Duration) -> Result<Wait<Received<Observation>>, LinkError> {
        Ok(self.observations.wait(self.settings.spin, timeout)?.0)
    }
}

/// Receives actions without taking part, for a monitor beside the simulator: the newest only.
pub struct ActionObserverLink {
    actions: Receiver<Action>,
    // Dropped last: the port above belongs to it.
    _node: Node<Ipc>,
}

impl ActionObserverLink {
    /// Opens or creates the action service of an instance.
    pub fn open(settings: &LinkSettings) -> Result<Self, LinkError> {
        join(settings, 0, |node| {
            let actions = Direction::<Action>::open(&node, &settings.instance, "action")?.receiver()?;
            Ok(Self { actions, _node: node })
        })
    }

    /// The newest action, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_action(&self) -> Result<Option<Action>, LinkError> {
        // Signals are not looked at; they must not pile up.
        self.actions.take_events()?;
        Ok(self.actions.poll()?.map(|sample| *sample.payload()))
    }
}
