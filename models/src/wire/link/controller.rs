//! The controller's end.

use std::cell::Cell;
use std::time::Duration;

use iceoryx2::prelude::Node;

use super::direction::{Direction, EVENT_CLOSED, EVENT_HELLO, EVENT_PUBLISHED, Received, Receiver, Sender};
use super::domain::{join, make_node};
use super::error::traffic;
use super::{Ipc, LinkError, LinkSettings, Wait};
use crate::wire::clock::monotonic_ns;
use crate::wire::{Action, Observation};

/// An observation received in shared memory; it stays valid while this is held.
pub type ObservationSample = Received<Observation>;

/// The controller's end: receives observations, publishes actions. However it ends, a panic included, the simulator is told.
pub struct ControllerLink {
    settings: LinkSettings,
    observations: Receiver<Observation>,
    actions: Sender<Action>,
    /// The simulator was told that no further action will come.
    said_closed: Cell<bool>,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

impl ControllerLink {
    /// Opens or creates the services of an instance, as their controller, and asks the simulator for its current
    /// observation.
    ///
    /// # Errors
    /// See [`LinkError`]; a second controller gets [`LinkError::Taken`].
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        let link = join(&settings.clone(), size_of::<Action>(), |node| {
            let observation = Direction::<Observation>::open(&node, &settings.instance, "observation")?;
            let action = Direction::<Action>::open(&node, &settings.instance, "action")?;
            let observations = observation.receiver()?;
            let actions = action.sender("controller")?;
            Ok(Self { settings, observations, actions, said_closed: Cell::new(false), node })
        })?;
        link.hello()?;
        Ok(link)
    }

    /// Asks the simulator to publish its current observation again.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn hello(&self) -> Result<(), LinkError> {
        self.actions.notify(EVENT_HELLO)
    }

    /// Waits for the next observation; [`Wait::Closed`] when the simulator has said that none will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_observation(&self, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        self.wait_observation_polling(self.settings.spin, timeout)
    }

    /// The same with its own time of polling before it blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_observation_polling(
        &self,
        spin: Duration,
        timeout: Duration,
    ) -> Result<Wait<ObservationSample>, LinkError> {
        Ok(self.observations.wait(spin, timeout)?.0)
    }

    /// The newest observation, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_observation(&self) -> Result<Option<ObservationSample>, LinkError> {
        self.observations.poll()
    }

    /// Publishes an action and wakes the simulator. `published_ns` is set here and returned.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn send(&self, mut action: Action) -> Result<u64, LinkError> {
        self.said_closed.set(false);
        action.published_ns = monotonic_ns();
        let sample = self.actions.publisher.loan_uninit().map_err(traffic("loaning an action"))?;
        sample.write_payload(action).send().map_err(traffic("publishing an action"))?;
        self.actions.notify(EVENT_PUBLISHED)?;
        Ok(action.published_ns)
    }

    /// Frees what peers that were killed have left in shared memory.
    pub fn clean_up_dead_peers(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// Tells the simulator that no further action will come; once told, it is not told again.
    ///
    /// # Errors
    /// [`LinkError::Traffic`]; dropping the link then tries once more.
    pub fn say_closed(&self) -> Result<(), LinkError> {
        if !self.said_closed.get() {
            self.actions.notify(EVENT_CLOSED)?;
            self.said_closed.set(true);
        }
        Ok(())
    }

    /// Tells the simulator that no further action will come, and leaves.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn close(self) -> Result<(), LinkError> {
        self.say_closed()
    }
}

/// Tells the simulator of an instance that no further action will come, on behalf of a controller whose own thread is stuck.
pub fn say_closed_for(settings: &LinkSettings) -> Result<(), LinkError> {
    let node = make_node(settings)?;
    Direction::<Action>::open(&node, &settings.instance, "action")?.waker()?.notify(EVENT_CLOSED)
}

impl Drop for ControllerLink {
    fn drop(&mut self) {
        // Nobody is left to hear of an error.
        let _ = self.say_closed();
    }
}
