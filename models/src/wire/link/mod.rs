//! The shared-memory link: services, their settings, and both ends.
//!
//! The observation's publisher is the simulator's end, the action's publisher the controller's. A second simulator or a second
//! controller on one instance is refused; recorders may listen in on observations. Waiting spins for a configurable while
//! (about 1 us to notice), then blocks on the event service (about 100 us).

mod controller;
mod direction;
mod domain;
mod error;
mod memory;
mod observer;
mod simulator;

use std::time::Duration;

pub use controller::{ControllerLink, ObservationSample, say_closed_for};
pub use domain::{forget_prefix, list_leftovers};
pub use error::LinkError;
pub use memory::shared_memory_number;
pub use observer::{ActionObserverLink, ObserverLink};
pub use simulator::{ObservationSlot, SimulatorLink};

type Ipc = iceoryx2::prelude::ipc::Service;

/// Which link, and how to wait on it.
#[derive(Debug, Clone)]
pub struct LinkSettings {
    /// Names the pair of services; letters, digits, `-`, `_` and `.`.
    pub instance: String,
    /// Prefix of all files in shared memory: peers meet only under the same one. Tests that run side by side use their own.
    pub prefix: Option<String>,
    /// How long a wait polls before it blocks.
    pub spin: Duration,
}

impl LinkSettings {
    /// The link of `instance` with 50 us of spinning; the prefix comes from the variable `RCWM_PREFIX`, if set.
    #[must_use]
    pub fn new(instance: &str) -> Self {
        let prefix = std::env::var("RCWM_PREFIX").ok().filter(|prefix| !prefix.is_empty());
        Self { instance: instance.to_owned(), prefix, spin: Duration::from_micros(50) }
    }
}

/// What a wait ended with.
#[derive(Debug)]
pub enum Wait<T> {
    Message(T),
    /// The time was up, or a signal to the process (Ctrl-C) has cut the wait short.
    TimedOut,
    /// The peer said that it closes.
    Closed,
}

/// Signals seen since the last look.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Events {
    /// A controller has connected and asks for the current observation.
    pub hello: bool,
    /// The peer said that it closes.
    pub closed: bool,
}

#[cfg(test)]
mod tests {
    use iceoryx2::prelude::ZeroCopySend;

    use super::direction::Direction;
    use super::domain::make_node;
    use super::*;
    use crate::wire::Action;

    /// Settings under a prefix of their own, which is forgotten at the end.
    struct Domain(LinkSettings);

    impl Drop for Domain {
        fn drop(&mut self) {
            forget_prefix(self.0.prefix.as_deref().unwrap());
        }
    }

    fn domain(name: &str) -> (LinkSettings, Domain) {
        let prefix = Some(format!("rcwm_unit_{}_{name}_", std::process::id()));
        let settings = LinkSettings { instance: name.to_owned(), prefix, spin: Duration::ZERO };
        (settings.clone(), Domain(settings))
    }

    const SOON: Duration = Duration::from_secs(5);

    #[test]
    fn an_observation_goes_over_and_its_answer_comes_back() {
        let (settings, _domain) = domain("both_ways");
        let simulator = SimulatorLink::open(settings.clone()).unwrap();
        let controller = ControllerLink::open(settings.clone()).unwrap();
        assert!(simulator.poll_events().unwrap().hello, "a new controller announces itself");
        simulator.publish(|observation| observation.sequence = 7).unwrap();
        let Wait::Message(observation) = controller.wait_observation(SOON).unwrap() else {
            panic!("no observation")
        };
        assert_eq!(observation.sequence, 7);
        assert!(observation.published_ns > 0);
        let action = Action { answers: 7, published_ns: 0, source: 0, reserved: 0, action: [0.5; 4] };
        controller.send(action).unwrap();
        let (Wait::Message(answer), _) = simulator.wait_action(SOON).unwrap() else { panic!("no action") };
        assert_eq!((answer.answers, answer.action), (7, [0.5; 4]));
        simulator.close().unwrap();
        assert!(matches!(controller.wait_observation(SOON).unwrap(), Wait::Closed));
        drop((observation, controller));
        assert_eq!(list_leftovers(&settings.prefix.unwrap()).unwrap(), Vec::<String>::new());
    }

    #[test]
    fn only_the_newest_observation_is_kept() {
        let (settings, _domain) = domain("newest");
        let simulator = SimulatorLink::open(settings.clone()).unwrap();
        let controller = ControllerLink::open(settings).unwrap();
        for sequence in 0..5 {
            simulator.publish(|observation| observation.sequence = sequence).unwrap();
        }
        let Wait::Message(observation) = controller.wait_observation(SOON).unwrap() else {
            panic!("no observation")
        };
        assert_eq!(observation.sequence, 4);
        assert!(matches!(controller.wait_observation(Duration::from_millis(20)).unwrap(), Wait::TimedOut));
    }

    #[test]
    fn the_last_observation_is_seen_before_the_end() {
        let (settings, _domain) = domain("end");
        let simulator = SimulatorLink::open(settings.clone()).unwrap();
        let controller = ControllerLink::open(settings).unwrap();
        simulator.publish(|observation| observation.sequence = 9).unwrap();
        simulator.close().unwrap();
        let Wait::Message(observation) = controller.wait_observation(SOON).unwrap() else {
            panic!("no observation")
        };
        assert_eq!(observation.sequence, 9);
        assert!(matches!(controller.wait_observation(SOON).unwrap(), Wait::Closed));
    }

    #[test]
    fn another_thread_tells_the_simulator_for_a_controller_that_is_stuck() {
        let (settings, _domain) = domain("stuck");
        let simulator = SimulatorLink::open(settings.clone()).unwrap();
        let _stuck = ControllerLink::open(settings.clone()).unwrap();
        simulator.poll_events().unwrap();
        say_closed_for(&settings).unwrap();
        assert!(simulator.wait_action(SOON).unwrap().1.closed);
    }

    #[test]
    fn a_second_simulator_and_a_second_controller_are_refused() {
        let (settings, _domain) = domain("second");
        let _simulator = SimulatorLink::open(settings.clone()).unwrap();
        let _controller = ControllerLink::open(settings.clone()).unwrap();
        let error = SimulatorLink::open(settings.clone()).err().unwrap();
        assert!(matches!(error, LinkError::Taken { role: "simulator", .. }), "{error}");
        let error = ControllerLink::open(settings).err().unwrap();
        assert!(matches!(error, LinkError::Taken { role: "controller", .. }), "{error}");
    }

    #[test]
    fn a_peer_of_another_version_is_refused() {
        #[derive(Debug, Clone, Copy, ZeroCopySend)]
        #[type_name("rcwm.Observation.v0")]
        #[repr(C)]
        struct OldObservation {
            sequence: u64,
        }
        let (settings, _domain) = domain("version");
        let node = make_node(&settings).unwrap();
        let _old = Direction::<OldObservation>::open(&node, &settings.instance, "observation").unwrap();
        let error = ControllerLink::open(settings).err().unwrap();
        assert!(error.to_string().contains("rcwm.Observation.v1"), "{error}");
    }

    #[test]
    fn names_that_shared_memory_cannot_carry_are_refused() {
        let (settings, _domain) = domain("names");
        for instance in ["", "a/b", "..", "with space"] {
            let settings = LinkSettings { instance: instance.into(), ..settings.clone() };
            assert!(matches!(SimulatorLink::open(settings), Err(LinkError::InstanceName(_))), "{instance:?}");
        }
        let settings = LinkSettings { prefix: Some("a/b".into()), ..settings };
        assert!(matches!(SimulatorLink::open(settings), Err(LinkError::Prefix(_))));
    }
}
