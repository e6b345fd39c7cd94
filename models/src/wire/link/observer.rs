//! Listening in: a recorder's or a monitor's end, beside the controller.

use std::cell::OnceCell;
use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::prelude::Node;

use super::announce::Inquirer;
use super::direction::{Direction, Received, Receiver, Topic};
use super::domain::{join, reserve_new};
use super::{Ipc, LinkError, LinkSettings, Wait};
use crate::wire::{Action, ActionHeader, Format, ObservationHeader, ObservationSample};

pub(super) fn observation_of(
    sample: Received<ObservationHeader>,
    format: &Arc<Format>,
) -> Result<ObservationSample, LinkError> {
    let expected = format.layout().observation_bytes;
    let wrong = |found| LinkError::MessageLength { service: "observation", found, expected };
    ObservationSample::new(sample, format).map_err(wrong)
}

pub(super) fn action_of(sample: &Received<ActionHeader>, format: &Format) -> Result<Action, LinkError> {
    let (payload, expected) = (sample.payload(), format.layout().action_bytes);
    let found = payload.len();
    if found != expected {
        return Err(LinkError::MessageLength { service: "action", found, expected });
    }
    let ActionHeader { answers, published_ns, source, .. } = *sample.user_header();
    // Whoever wrote it says where its bytes begin: not always where numbers do.
    let action = payload.as_chunks().0.iter().map(|bytes| f32::from_ne_bytes(*bytes)).collect();
    Ok(Action { answers, published_ns, source, action })
}

/// One direction of an instance whose robot was found.
struct Found<H: super::direction::Header> {
    format: Arc<Format>,
    receiver: Receiver<H>,
}

/// One direction of an instance, whose robot may come later.
struct Listener<H: super::direction::Header> {
    settings: LinkSettings,
    topic: &'static str,
    found: OnceCell<Found<H>>,
    inquirer: Inquirer,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

impl<H: super::direction::Header> Listener<H> {
    fn open(settings: LinkSettings, topic: &'static str) -> Result<Self, LinkError> {
        join(&settings.clone(), 0, |node| {
            let inquirer = Inquirer::open(&node, &settings.instance)?;
            Ok(Self { settings, topic, found: OnceCell::new(), inquirer, node })
        })
    }

    fn find(&self, timeout: Duration) -> Result<Option<&Found<H>>, LinkError> {
        if let Some(found) = self.found.get() {
            return Ok(Some(found));
        }
        let Some(interface) = self.inquirer.await_robot(&self.node, timeout)? else { return Ok(None) };
        let format = Format::of(interface);
        let (instance, interface_hash) = (self.settings.instance.as_str(), Some(format.hash()));
        let topic = Topic { instance, name: self.topic, interface_hash, history: false };
        let receiver = reserve_new(&self.settings, 0, || Direction::open(&self.node, &topic)?.receiver())?;
        Ok(Some(self.found.get_or_init(|| Found { format, receiver })))
    }
}

/// Receives observations without taking part: nobody waits for it, and it sees the newest only.
pub struct ObserverLink(Listener<ObservationHeader>);

impl ObserverLink {
    /// Joins an instance, whose robot may come later.
    ///
    /// # Errors
    /// See [`LinkError`].
    pub fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        Listener::open(settings, "observation").map(Self)
    }

    /// Waits until the robot has said its interface.
    ///
    /// # Errors
    /// See [`LinkError`].
    pub fn wait_robot(&self, timeout: Duration) -> Result<Option<Arc<Format>>, LinkError> {
        Ok(self.0.find(timeout)?.map(|found| Arc::clone(&found.format)))
    }

    /// Waits for the next observation; [`Wait::Closed`] when the simulator has said that none will come.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn wait_observation(&self, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        let start = Instant::now();
        let Some(Found { format, receiver: observations }) = self.0.find(timeout)? else {
            return Ok(Wait::TimedOut);
        };
        let left = timeout.saturating_sub(start.elapsed());
        Ok(match observations.wait(self.0.settings.spin, left)?.0 {
            Wait::Message(sample) => Wait::Message(observation_of(sample, format)?),
            Wait::TimedOut => Wait::TimedOut,
            Wait::Closed => Wait::Closed,
        })
    }
}

/// Receives actions without taking part, for a monitor beside the simulator: the newest only.
pub struct ActionObserverLink(Listener<ActionHeader>);

impl ActionObserverLink {
    /// Joins an instance, whose robot may come later.
    ///
    /// # Errors
    /// See [`LinkError`].
    pub fn open(settings: &LinkSettings) -> Result<Self, LinkError> {
        Listener::open(settings.clone(), "action").map(Self)
    }

    /// The newest action, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_action(&self) -> Result<Option<Action>, LinkError> {
        let Some(Found { format, receiver: actions }) = self.0.find(Duration::ZERO)? else { return Ok(None) };
        // Signals are not looked at; they must not pile up.
        actions.take_events()?;
        actions.poll()?.map(|sample| action_of(&sample, format)).transpose()
    }
}
