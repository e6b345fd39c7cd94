//! The simulator's end.

use std::cell::Cell;
use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::prelude::Node;

use super::announce::Announcer;
use super::direction::{Direction, EVENT_CLOSED, Loan, Received, Receiver, Sender, Topic};
use super::domain::join;
use super::observer::action_of;
use super::{Events, Ipc, LinkError, LinkSettings, Wait};
use crate::wire::clock::monotonic_ns;
use crate::wire::{Action, ActionHeader, Format, ObservationHeader, ObservationMut, OwnedObservation};

/// The simulator's end (or a robot's): publishes observations, receives actions.
pub struct SimulatorLink {
    settings: LinkSettings,
    format: Arc<Format>,
    announcer: Announcer,
    observations: Sender<ObservationHeader>,
    actions: Receiver<ActionHeader>,
    misfits: Cell<u64>,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

/// A free place in shared memory for the next observation.
pub struct ObservationSlot {
    header: ObservationHeader,
    sample: Loan<ObservationHeader>,
    format: Arc<Format>,
}

impl ObservationSlot {
    pub fn edit(&mut self) -> ObservationMut<'_> {
        let payload = self.sample.payload_mut();
        ObservationMut { header: &mut self.header, format: &self.format, payload }
    }
}

impl SimulatorLink {
    /// Opens or creates the services of an instance, as their simulator, and says what it offers.
    ///
    /// # Errors
    /// See [`LinkError`]; a second simulator gets [`LinkError::Taken`].
    pub fn open(settings: LinkSettings, format: &Arc<Format>) -> Result<Self, LinkError> {
        let bytes = format.layout().observation_bytes;
        let link = join(&settings.clone(), bytes, |node| {
            let (instance, interface_hash) = (settings.instance.as_str(), Some(format.hash()));
            let topic = |name| Topic { instance, name, interface_hash, history: false };
            let actions = Direction::open(&node, &topic("action"))?.receiver()?;
            let observations = Direction::open(&node, &topic("observation"))?.sender("simulator", bytes)?;
            let announcer = Announcer::open(&node, instance, format)?;
            let (format, misfits) = (Arc::clone(format), Cell::new(0));
            Ok(Self { settings, format, announcer, observations, actions, misfits, node })
        })?;
        link.announcer.announce()?;
        Ok(link)
    }

    #[must_use]
    pub fn format(&self) -> &Arc<Format> {
        &self.format
    }

    /// Publishes one observation and wakes the controller. `published_ns` is set here.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn publish(&self, fill: impl FnOnce(&mut ObservationMut<'_>)) -> Result<(), LinkError> {
        let mut slot = self.slot()?;
        fill(&mut slot.edit());
        self.send(slot)
    }

    /// Publishes a copy. `published_ns` is that of now.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn publish_copy(&self, observation: &OwnedObservation) -> Result<(), LinkError> {
        self.publish(|slot| slot.copy(&observation.view()))
    }

    /// A place in shared memory of zeros, to be filled and sent.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn slot(&self) -> Result<ObservationSlot, LinkError> {
        let sample = self.observations.loan(self.format.layout().observation_bytes)?;
        let header = ObservationHeader::zeroed();
        Ok(ObservationSlot { header, sample, format: Arc::clone(&self.format) })
    }

    /// Sends a filled place and wakes the controller. `published_ns` is set here.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn send(&self, mut slot: ObservationSlot) -> Result<(), LinkError> {
        slot.header.published_ns = monotonic_ns();
        if slot.header.period_ns == 0 {
            // In lock-step nothing is due at a time of its own.
            slot.header.scheduled_ns = slot.header.published_ns;
        }
        *slot.sample.user_header_mut() = slot.header;
        self.observations.send(slot.sample)
    }

    /// Waits for the next action of any sequence.
    ///
    /// Ends early with [`Wait::TimedOut`] and `hello` set when a controller has connected: publish the current
    /// observation again, it has not seen it.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_action(&self, timeout: Duration) -> Result<(Wait<Action>, Events), LinkError> {
        let start = Instant::now();
        loop {
            let left = timeout.saturating_sub(start.elapsed());
            let (wait, events) = self.actions.wait(self.settings.spin, left)?;
            let asked = self.tell(events)?;
            let wait = match wait {
                Wait::Message(sample) => match self.fitting(&sample) {
                    Some(action) => Wait::Message(action),
                    None if start.elapsed() < timeout => continue,
                    None => Wait::TimedOut,
                },
                Wait::TimedOut if asked && !events.hello && start.elapsed() < timeout => continue,
                Wait::TimedOut => Wait::TimedOut,
                // A controller may come and go; only its absence matters here.
                Wait::Closed => Wait::TimedOut,
            };
            return Ok((wait, events));
        }
    }

    /// Says the interface where somebody has asked.
    fn tell(&self, events: Events) -> Result<bool, LinkError> {
        if events.asked {
            self.announcer.announce()?;
        }
        Ok(events.asked)
    }

    /// The newest action, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_action(&self) -> Result<Option<Action>, LinkError> {
        let asked = self.actions.take_asked()?;
        self.tell(Events { asked, ..Events::default() })?;
        Ok(self.actions.poll()?.and_then(|sample| self.fitting(&sample)))
    }

    /// An action of the interface's length; another one is no answer, and is counted.
    fn fitting(&self, sample: &Received<ActionHeader>) -> Option<Action> {
        let action = action_of(sample, &self.format).ok();
        self.misfits.set(self.misfits.get() + u64::from(action.is_none()));
        action
    }

    /// Actions that came with another length than the interface's, and were dropped.
    #[must_use]
    pub fn misfits(&self) -> u64 {
        self.misfits.get()
    }

    /// Signals since the last look; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_events(&self) -> Result<Events, LinkError> {
        let events = self.actions.take_events()?;
        self.tell(events)?;
        Ok(events)
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
        self.say_closed()
    }

    /// The same, by who has something to do yet.
    pub(in crate::wire) fn say_closed(&self) -> Result<(), LinkError> {
        self.observations.notify(EVENT_CLOSED)
    }
}
