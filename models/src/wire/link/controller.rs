//! The controller's end.

use std::cell::{Cell, OnceCell};
use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::prelude::Node;

use super::announce::Inquirer;
use super::direction::{
    Direction, EVENT_CLOSED, EVENT_HELLO, Receiver, Sender, Topic, make_waker, open_event,
};
use super::domain::{join, make_node, reserve_new};
use super::error::traffic;
use super::observer::observation_of;
use super::{Ipc, LinkError, LinkSettings, Wait};
use crate::interface::{Interface, Mismatch};
use crate::wire::clock::monotonic_ns;
use crate::wire::{Action, ActionHeader, Format, ObservationHeader, ObservationSample};

/// Everything in which a robot is not what a controller needs; empty where it fits.
pub type Needs = Box<dyn Fn(&Interface) -> Vec<Mismatch> + Send>;

/// The controller's end: receives observations, publishes actions. However it ends, a panic included, the simulator is told.
///
/// It may be opened before there is a robot: as soon as one says its interface, it is compared with what the controller needs, and the
/// link is made.
pub struct ControllerLink {
    settings: LinkSettings,
    needs: Needs,
    robot: OnceCell<Robot>,
    inquirer: Inquirer,
    /// The simulator was told that no further action will come.
    said_closed: Cell<bool>,
    // Dropped last: the ports above belong to it.
    node: Node<Ipc>,
}

/// The robot that was found.
struct Robot {
    format: Arc<Format>,
    observations: Receiver<ObservationHeader>,
    actions: Sender<ActionHeader>,
}

impl ControllerLink {
    /// Joins an instance as its controller and asks the robot for its interface. `needs` says what a robot's interface lacks.
    ///
    /// # Errors
    /// See [`LinkError`]. A second controller gets [`LinkError::Taken`], here or, where the robot comes later, from the first wait after.
    pub fn open(
        settings: LinkSettings,
        needs: impl Fn(&Interface) -> Vec<Mismatch> + Send + 'static,
    ) -> Result<Self, LinkError> {
        let link = join(&settings.clone(), 0, |node| {
            let inquirer = Inquirer::open(&node, &settings.instance)?;
            let (robot, said_closed) = (OnceCell::new(), Cell::new(false));
            Ok(Self { settings, needs: Box::new(needs), robot, inquirer, said_closed, node })
        })?;
        link.find_robot(Duration::ZERO)?;
        Ok(link)
    }

    /// How messages of the robot are laid out; none before there was one.
    #[must_use]
    pub fn format(&self) -> Option<&Arc<Format>> {
        self.robot.get().map(|robot| &robot.format)
    }

    /// Waits until the robot has said its interface, and it fits.
    ///
    /// # Errors
    /// [`LinkError::DoesNotFit`] and others.
    pub fn wait_robot(&self, timeout: Duration) -> Result<Option<Arc<Format>>, LinkError> {
        Ok(self.find_robot(timeout)?.map(|robot| Arc::clone(&robot.format)))
    }

    fn find_robot(&self, timeout: Duration) -> Result<Option<&Robot>, LinkError> {
        if let Some(robot) = self.robot.get() {
            return Ok(Some(robot));
        }
        let Some(interface) = self.inquirer.await_robot(&self.node, timeout)? else { return Ok(None) };
        let mismatches = (self.needs)(&interface);
        if !mismatches.is_empty() {
            let (instance, robot) = (self.settings.instance.clone(), interface.name);
            return Err(LinkError::DoesNotFit { instance, robot, mismatches });
        }
        let format = Format::of(interface);
        let bytes = format.layout().action_bytes;
        let instance = self.settings.instance.as_str();
        let topic = |name| Topic { instance, name, interface_hash: Some(format.hash()), history: false };
        let (observations, actions) = reserve_new(&self.settings, bytes, || {
            let observations = Direction::open(&self.node, &topic("observation"))?.receiver()?;
            Ok((observations, Direction::open(&self.node, &topic("action"))?.sender("controller", bytes)?))
        })?;
        let robot = self.robot.get_or_init(|| Robot { format: Arc::clone(&format), observations, actions });
        self.hello()?;
        Ok(Some(robot))
    }

    /// Asks the simulator to publish its current observation again.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn hello(&self) -> Result<(), LinkError> {
        if self.robot.get().is_none() { self.inquirer.ask() } else { self.inquirer.robot.notify(EVENT_HELLO) }
    }

    /// Waits for the next observation; [`Wait::Closed`] when the simulator has said that none will come.
    ///
    /// # Errors
    /// Those of [`Self::wait_observation_polling`].
    pub fn wait_observation(&self, timeout: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        self.wait_observation_polling(self.settings.spin, timeout)
    }

    /// The same with its own time of polling before it blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`]; where the robot has just been found, also why no link to it can be made.
    pub fn wait_observation_polling(
        &self,
        spin: Duration,
        timeout: Duration,
    ) -> Result<Wait<ObservationSample>, LinkError> {
        let (robot, left) = match self.robot.get() {
            Some(robot) => (robot, timeout),
            None => {
                let start = Instant::now();
                let Some(robot) = self.find_robot(timeout)? else { return Ok(Wait::TimedOut) };
                (robot, timeout.saturating_sub(start.elapsed()))
            }
        };
        Ok(match robot.observations.wait(spin, left)?.0 {
            Wait::Message(sample) => Wait::Message(observation_of(sample, &robot.format)?),
            Wait::TimedOut => Wait::TimedOut,
            Wait::Closed => Wait::Closed,
        })
    }

    /// The newest observation, if one is waiting; never blocks.
    ///
    /// # Errors
    /// [`LinkError::Traffic`].
    pub fn poll_observation(&self) -> Result<Option<ObservationSample>, LinkError> {
        let Some(robot) = self.robot.get() else { return Ok(None) };
        robot.observations.poll()?.map(|sample| observation_of(sample, &robot.format)).transpose()
    }

    /// Publishes an action and wakes the simulator. `published_ns` is set here and returned.
    ///
    /// # Errors
    /// [`LinkError::Traffic`]; [`LinkError::MessageLength`] where it has another count of numbers than the robot's.
    pub fn send(&self, action: &Action) -> Result<u64, LinkError> {
        let nobody = || traffic("publishing an action")("there was no robot yet");
        let robot = self.robot.get().ok_or_else(nobody)?;
        let (found, expected) = (4 * action.action.len(), robot.format.layout().action_bytes);
        if found != expected {
            return Err(LinkError::MessageLength { service: "action", found, expected });
        }
        self.said_closed.set(false);
        let published_ns = monotonic_ns();
        let mut message = robot.actions.loan(expected)?;
        let Action { answers, source, .. } = *action;
        *message.user_header_mut() = ActionHeader { answers, published_ns, source, reserved: 0 };
        message.payload_mut().copy_from_slice(bytemuck::cast_slice(&action.action));
        robot.actions.send(message)?;
        Ok(published_ns)
    }

    /// Frees what peers that were killed have left in shared memory.
    pub fn clean_up_dead_peers(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// Forgets the robot, which has said that it leaves: the next may be another one.
    pub fn forget_robot(&mut self) {
        self.robot.take();
        self.inquirer.forget();
    }

    /// Tells the simulator that no further action will come; once told, it is not told again. Where none was found, or it was refused,
    /// it is told nothing: it may be another controller's.
    ///
    ///
    /// # Errors
    /// [`LinkError::Traffic`]; dropping the link then tries once more.
    pub fn say_closed(&self) -> Result<(), LinkError> {
        if self.robot.get().is_some() && !self.said_closed.get() {
            self.inquirer.robot.notify(EVENT_CLOSED)?;
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
    make_waker(&open_event(&node, &settings.instance, "action")?)?.notify(EVENT_CLOSED)
}

impl Drop for ControllerLink {
    fn drop(&mut self) {
        // Nobody is left to hear of an error.
        let _ = self.say_closed();
    }
}
