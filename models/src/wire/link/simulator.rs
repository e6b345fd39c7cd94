//! The simulator's end.

use std::time::Duration;

use iceoryx2::prelude::Node;

use super::direction::{Direction, EVENT_CLOSED, EVENT_PUBLISHED, Receiver, Sender};
use super::domain::join;
use super::error::traffic;
use super::{Events, Ipc, LinkError, LinkSettings, Wait};
use crate::wire::clock::monotonic_ns;
use crate::wire::{Action, Observation};

/// The simulator's end (or a robot's): publishes observations, receives actions.
pub struct SimulatorLink {
    settings: LinkSettings,
    observations: Sender<Observation>,
    actions: Receiver<Action>,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

/// A free place in shared memory for the next observation.
pub struct ObservationSlot {
    sample: iceoryx2::sample_mut::SampleMut<Ipc, Observation, ()>,
}

impl std::ops::Deref for ObservationSlot {
    type Target = Observation;
    fn deref(&self) -> &Observation {
        self.sample.payload()
    }
}

impl std::ops::DerefMut for ObservationSlot {
    fn deref_mut(&mut self) -> &mut Observation {
        self.sample.payload_mut()
    }
}

impl SimulatorLink {
    /// Opens or creates the services of an instance, as their simulator.
    ///
    /// # Errors
    /// See [`LinkError`]; a second simulator gets [`LinkError::Taken`].
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        join(&settings.clone(), size_of::<Observation>(), |node| {
            let observation = Direction::<Observation>::open(&node, &settings.instance, "observation")?;
            let action = Direction::<Action>::open(&node, &settings.instance, "action")?;
            let actions = action.receiver()?;
            let observations = observation.sender("simulator")?;
            Ok(Self { settings, observations, actions, node })
        })
    }

    /// Publishes one observation and wakes the controller. `published_ns` is set here.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn publish(&self, fill: impl FnOnce(&mut Observation)) -> Result<(), LinkError> {
        let mut slot = self.slot()?;
        fill(&mut slot);
        self.send(slot)
    }

    /// A zeroed place in shared memory, to be filled and sent.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn slot(&self) -> Result<ObservationSlot, LinkError> {
        let sample = self.observations.publisher.loan_uninit().map_err(traffic("loaning an observation"))?;
        Ok(ObservationSlot { sample: sample.write_payload(Observation::zeroed()) })
    }

    /// Sends a filled place and wakes the controller. `published_ns` is set here.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn send(&self, mut slot: ObservationSlot) -> Result<(), LinkError> {
        slot.published_ns = monotonic_ns();
        if slot.period_ns == 0 {
            // In lock-step nothing is due at a time of its own.
            slot.scheduled_ns = slot.published_ns;
        }
        slot.sample.send().map_err(traffic("publishing an observation"))?;
        self.observations.notify(EVENT_PUBLISHED)
    }

    /// Waits for the next action of any sequence.
    ///
    /// Ends early with [`Wait::TimedOut`] and `hello` set when a controller has connected: publish the current
    /// observation again, it has not seen it.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_action(&self, timeout: Duration) -> Result<(Wait<Action>, Events), LinkError> {
        let (wait, events) = self.actions.wait(self.settings.spin, timeout)?;
        let wait = match wait {
            Wait::Message(sample) => Wait::Message(*sample.payload()),
            Wait::TimedOut => Wait::TimedOut,
            // A controller may come and go; only its absence matters here.
            Wait::Closed => Wait::TimedOut,
        };
        Ok((wait, events))
    }

    /// The newest action, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_action(&self) -> Result<Option<Action>, LinkError> {
        Ok(self.actions.poll()?.map(|sample| *sample.payload()))
    }

    /// Signals since the last look; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_events(&self) -> Result<Events, LinkError> {
        self.actions.take_events()
    }

    /// Frees what peers that were killed have left in shared memory.
    pub fn clean_up_dead_peers(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// Tells the controller that no further observation will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn close(self) -> Result<(), LinkError> {
        self.observations.notify(EVENT_CLOSED)
    }
}
