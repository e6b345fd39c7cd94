//! The robot says what it offers, and whoever comes asks.

use std::time::Duration;

use iceoryx2::prelude::Node;

use super::direction::{Direction, EVENT_ASKED, Receiver, Sender, Topic, Waker, make_waker, open_event};
use super::{Ipc, LinkError, Wait};
use crate::interface::Interface;
use crate::wire::Format;

fn open_topic(node: &Node<Ipc>, instance: &str) -> Result<Direction<()>, LinkError> {
    Direction::open(node, &Topic { instance, name: "interface", interface_hash: None, history: true })
}

/// The robot's end.
pub(super) struct Announcer {
    text: String,
    sender: Sender<()>,
}

impl Announcer {
    pub(super) fn open(node: &Node<Ipc>, instance: &str, format: &Format) -> Result<Self, LinkError> {
        let text = format.interface().canonical();
        let sender = open_topic(node, instance)?.sender("simulator", text.len())?;
        Ok(Self { text, sender })
    }

    pub(super) fn announce(&self) -> Result<(), LinkError> {
        let mut message = self.sender.loan(self.text.len())?;
        message.payload_mut().copy_from_slice(self.text.as_bytes());
        self.sender.send(message)
    }
}

/// The end of whoever wants to know.
pub(super) struct Inquirer {
    instance: String,
    texts: Receiver<()>,
    /// The robot's waker.
    pub(super) robot: Waker,
}

impl Inquirer {
    pub(super) fn open(node: &Node<Ipc>, instance: &str) -> Result<Self, LinkError> {
        let texts = open_topic(node, instance)?.receiver()?;
        let robot = make_waker(&open_event(node, instance, "action")?)?;
        let inquirer = Self { instance: instance.to_owned(), texts, robot };
        inquirer.ask()?;
        Ok(inquirer)
    }

    pub(super) fn instance(&self) -> &str {
        &self.instance
    }

    /// Asks the robot, if it is there, to say its interface again.
    pub(super) fn ask(&self) -> Result<(), LinkError> {
        self.robot.notify(EVENT_ASKED)
    }

    /// The robot's interface, if it has come within the time.
    pub(super) fn wait(&self, timeout: Duration) -> Result<Option<Interface>, LinkError> {
        let (Wait::Message(text), _) = self.texts.wait(Duration::ZERO, timeout)? else { return Ok(None) };
        let text = String::from_utf8_lossy(text.payload());
        let wrong = |source| LinkError::NoInterface { instance: self.instance.clone(), source };
        Interface::parse(&text).map(Some).map_err(wrong)
    }
}
