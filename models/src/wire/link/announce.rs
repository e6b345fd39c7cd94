//! The robot says what it offers, and whoever comes asks.

use std::cell::Cell;
use std::time::{Duration, Instant};

use iceoryx2::prelude::Node;

use super::direction::{Direction, EVENT_ASKED, Receiver, Sender, Topic, Waker, make_waker, open_event};
use super::{Ipc, LinkError, Wait};
use crate::interface::Interface;
use crate::wire::{Format, ObservationHeader};

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

/// How often a robot that is not there yet, or did not listen, is asked again.
const ASK_EVERY: Duration = Duration::from_millis(250);

/// The end of whoever wants to know.
pub(super) struct Inquirer {
    instance: String,
    texts: Receiver<()>,
    asked: Cell<Instant>,
    /// The robot's waker.
    pub(super) robot: Waker,
}

impl Inquirer {
    pub(super) fn open(node: &Node<Ipc>, instance: &str) -> Result<Self, LinkError> {
        let texts = open_topic(node, instance)?.receiver()?;
        let robot = make_waker(&open_event(node, instance, "action")?)?;
        let inquirer = Self { instance: instance.to_owned(), texts, asked: Cell::new(Instant::now()), robot };
        inquirer.ask()?;
        Ok(inquirer)
    }

    /// Asks the robot, if it is there, to say its interface again.
    pub(super) fn ask(&self) -> Result<(), LinkError> {
        self.asked.set(Instant::now());
        self.robot.notify(EVENT_ASKED)
    }

    /// Drops what a robot that has left has said.
    pub(super) fn forget(&self) {
        while let Ok(Some(_)) = self.texts.poll() {}
    }

    /// Asks until the robot has said its interface, the time is up, or a signal to the process has cut the wait short.
    pub(super) fn await_robot(
        &self,
        node: &Node<Ipc>,
        timeout: Duration,
    ) -> Result<Option<Interface>, LinkError> {
        let start = Instant::now();
        loop {
            let slice = timeout.saturating_sub(start.elapsed()).min(ASK_EVERY);
            let slice_start = Instant::now();
            if let Some(interface) = self.wait(slice)? {
                return Ok(Some(interface));
            }
            Direction::<ObservationHeader>::check_version(node, &self.instance, "observation")?;
            // Callers with short waits come again and again: when to ask is not counted from theirs.
            if self.asked.get().elapsed() >= ASK_EVERY {
                self.ask()?;
            }
            if start.elapsed() >= timeout || slice_start.elapsed() < slice {
                return Ok(None);
            }
        }
    }

    /// The robot's interface, if it has come within the time.
    fn wait(&self, timeout: Duration) -> Result<Option<Interface>, LinkError> {
        let (Wait::Message(text), _) = self.texts.wait(Duration::ZERO, timeout)? else { return Ok(None) };
        // Copied first: whoever wrote it can still write there.
        let bytes = text.payload().to_vec();
        let text = String::from_utf8_lossy(&bytes);
        let wrong = |source| LinkError::NoInterface { instance: self.instance.clone(), source };
        Interface::parse(&text).map(Some).map_err(wrong)
    }
}
