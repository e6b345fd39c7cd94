use std::sync::Arc;

use iceoryx2::prelude::{AttributeSpecifier, ZeroCopySend};

use super::announce::Announcer;
use super::direction::{Direction, Topic};
use super::domain::make_node;
use super::*;
use crate::interface::{Interface, Mismatch};
use crate::wire::{Action, ActionHeader, Format, ObservationHeader};

/// Settings under a prefix of their own, which is forgotten at the end.
pub(in crate::wire) struct Domain(LinkSettings);

impl Drop for Domain {
    fn drop(&mut self) {
        forget_prefix(self.0.prefix.as_deref().unwrap());
    }
}

pub(in crate::wire) fn domain(name: &str) -> (LinkSettings, Domain) {
    let prefix = Some(format!("rcwm_unit_{}_{name}_", std::process::id()));
    let settings = LinkSettings { instance: name.to_owned(), prefix, spin: Duration::ZERO };
    (settings.clone(), Domain(settings))
}

pub(in crate::wire) const SOON: Duration = Duration::from_secs(5);

pub(in crate::wire) fn anything(_: &Interface) -> Vec<Mismatch> {
    Vec::new()
}

/// Both ends, one that has found the other.
fn pair(settings: &LinkSettings, format: &Arc<Format>) -> (SimulatorLink, ControllerLink) {
    let simulator = SimulatorLink::open(settings.clone(), format).unwrap();
    let controller = ControllerLink::open(settings.clone(), anything).unwrap();
    assert!(simulator.poll_events().unwrap().asked);
    assert_eq!(controller.wait_robot(SOON).unwrap().unwrap(), *format);
    (simulator, controller)
}

pub(in crate::wire) fn arm() -> Arc<Format> {
    Format::of(Interface::parse(include_str!("../../interface/arm.toml")).unwrap())
}

#[test]
fn an_observation_goes_over_and_its_answer_comes_back() {
    for format in [Format::metaworld(), arm()] {
        let (settings, _domain) = domain(&format!("both_ways_{}", format.action_numbers()));
        let (simulator, controller) = pair(&settings, &format);
        assert!(simulator.poll_events().unwrap().hello, "a new controller announces itself");
        simulator
            .publish(|observation| {
                observation.sequence = 7;
                observation.captured_ns[0] = 3;
                observation.state()[1] = 0.25;
                observation.image(0)[5] = 9;
            })
            .unwrap();
        let Wait::Message(observation) = controller.wait_observation(SOON).unwrap() else {
            panic!("no observation")
        };
        assert_eq!((observation.sequence, observation.captured_ns[0]), (7, 3));
        assert_eq!((observation.view().state()[1], observation.view().image(0)[5]), (0.25, 9));
        assert!(observation.published_ns > 0);
        let mut numbers = format.zeros();
        numbers.fill(0.5);
        controller.send(&Action { answers: 7, published_ns: 0, source: 0, action: numbers }).unwrap();
        let (Wait::Message(answer), _) = simulator.wait_action(SOON).unwrap() else { panic!("no action") };
        assert_eq!((answer.answers, answer.action), (7, numbers));
        simulator.close().unwrap();
        assert!(matches!(controller.wait_observation(SOON).unwrap(), Wait::Closed));
        drop((observation, controller));
        assert_eq!(list_leftovers(&settings.prefix.unwrap()).unwrap(), Vec::<String>::new());
    }
}

#[test]
fn a_controller_may_come_before_its_robot_and_an_observer_too() {
    let (settings, _domain) = domain("early");
    let controller = ControllerLink::open(settings.clone(), anything).unwrap();
    let observer = ObserverLink::open(settings.clone()).unwrap();
    let nothing = controller.wait_observation(Duration::from_millis(5)).unwrap();
    assert!(matches!(nothing, Wait::TimedOut) && controller.format().is_none());
    let simulator = SimulatorLink::open(settings, &arm()).unwrap();
    assert!(controller.wait_robot(SOON).unwrap().is_some() && observer.wait_robot(SOON).unwrap().is_some());
    assert!(simulator.poll_events().unwrap().hello);
    simulator.publish(|observation| observation.sequence = 2).unwrap();
    let Wait::Message(seen) = observer.wait_observation(SOON).unwrap() else { panic!("no observation") };
    assert_eq!(seen.sequence, 2);
}

#[test]
fn a_robot_that_does_not_fit_is_refused_by_name() {
    let (settings, _domain) = domain("unfit");
    let needed = arm().interface().clone();
    let mut other = needed.clone();
    other.action[0].high[1] = 1.5;
    let simulator = SimulatorLink::open(settings.clone(), &Format::of(other)).unwrap();
    let needs = move |robot: &Interface| crate::interface::mismatches(&needed, &["front"], robot);
    let controller = ControllerLink::open(settings, needs).unwrap();
    simulator.poll_events().unwrap();
    let error = controller.wait_observation(SOON).unwrap_err().to_string();
    assert!(error.contains("action arm: limits of j2") && error.contains("-1.7 to 1.5"), "{error}");
}

#[test]
fn a_robot_of_another_interface_is_refused_while_a_controller_of_the_last_one_is_there() {
    let (settings, _domain) = domain("replaced");
    let (simulator, _controller) = pair(&settings, &arm());
    drop(simulator);
    let error = SimulatorLink::open(settings.clone(), &Format::metaworld()).err().unwrap();
    assert!(matches!(error, LinkError::OtherInterface { .. }), "{error}");
    SimulatorLink::open(settings, &arm()).unwrap();
}

#[test]
fn only_the_newest_observation_is_kept() {
    let (settings, _domain) = domain("newest");
    let (simulator, controller) = pair(&settings, &Format::metaworld());
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
    let (simulator, controller) = pair(&settings, &Format::metaworld());
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
    let (simulator, _stuck) = pair(&settings, &Format::metaworld());
    simulator.poll_events().unwrap();
    say_closed_for(&settings).unwrap();
    assert!(simulator.wait_action(SOON).unwrap().1.closed);
}

#[test]
fn a_second_simulator_and_a_second_controller_are_refused() {
    let (settings, _domain) = domain("second");
    let format = Format::metaworld();
    let (simulator, _controller) = pair(&settings, &format);
    let error = SimulatorLink::open(settings.clone(), &format).err().unwrap();
    assert!(matches!(error, LinkError::Taken { role: "simulator", .. }), "{error}");
    let second = ControllerLink::open(settings, anything);
    let error = second.and_then(|second| {
        simulator.poll_events()?;
        second.wait_observation(SOON)
    });
    let error = error.err().unwrap();
    assert!(matches!(error, LinkError::Taken { role: "controller", .. }), "{error}");
    // The refused one has gone by now, and the first goes on.
    assert!(!simulator.poll_events().unwrap().closed, "a refused controller ended another's robot");
}

#[test]
fn a_peer_of_another_version_is_refused() {
    #[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
    #[type_name("rcwm.Observation.v1")]
    #[repr(C)]
    struct OldObservation {
        sequence: u64,
    }
    let (settings, _domain) = domain("version");
    let node = make_node(&settings).unwrap();
    let topic = |name| Topic { instance: &settings.instance, name, interface_hash: None, history: false };
    let _old = Direction::<OldObservation>::open(&node, &topic("observation")).unwrap();
    let error = SimulatorLink::open(settings.clone(), &Format::metaworld()).err().unwrap();
    assert!(error.to_string().contains("rcwm.Observation.v2"), "{error}");
    let error = ControllerLink::open(settings, anything).err().unwrap();
    assert!(error.to_string().contains("rcwm.Observation.v2"), "{error}");
}

#[test]
fn messages_that_do_not_keep_to_the_interface_are_refused() {
    let (settings, _domain) = domain("lengths");
    let format = arm();
    let node = make_node(&settings).unwrap();
    let topic = |name| Topic {
        instance: &settings.instance,
        name,
        interface_hash: Some(format.hash()),
        history: false,
    };
    let observations = Direction::<ObservationHeader>::open(&node, &topic("observation")).unwrap();
    let observations = observations.sender("simulator", 64).unwrap();
    let announcer = Announcer::open(&node, &settings.instance, &format).unwrap();
    let controller = ControllerLink::open(settings.clone(), anything).unwrap();
    announcer.announce().unwrap();
    assert!(controller.wait_robot(SOON).unwrap().is_some());
    observations.send(observations.loan(64).unwrap()).unwrap();
    let error = controller.wait_observation(SOON).unwrap_err();
    assert!(matches!(error, LinkError::MessageLength { found: 64, .. }), "{error}");
    let short = Action { answers: 0, published_ns: 0, source: 0, action: [0.0].into() };
    let error = controller.send(&short).unwrap_err();
    assert!(matches!(error, LinkError::MessageLength { found: 4, expected: 8, .. }), "{error}");
    drop(controller);
    let actions = Direction::<ActionHeader>::open(&node, &topic("action")).unwrap();
    let actions = actions.sender("controller", 64).unwrap();
    drop(observations);
    drop(announcer);
    let simulator = SimulatorLink::open(settings, &format).unwrap();
    actions.send(actions.loan(12).unwrap()).unwrap();
    // No answer, and no end of the robot either.
    let (wait, _) = simulator.wait_action(Duration::from_millis(20)).unwrap();
    assert!(matches!(wait, Wait::TimedOut) && simulator.misfits() == 1, "{wait:?}");
    actions.send(actions.loan(12).unwrap()).unwrap();
    assert!(simulator.poll_action().unwrap().is_none() && simulator.misfits() == 2);
    actions.send(actions.loan(8).unwrap()).unwrap();
    assert!(simulator.poll_action().unwrap().is_some());
}

#[test]
fn a_controller_that_stays_takes_a_robot_with_another_interface() {
    let (settings, _domain) = domain("stays");
    let (simulator, mut controller) = pair(&settings, &Format::metaworld());
    simulator.close().unwrap();
    assert!(matches!(controller.wait_observation(SOON).unwrap(), Wait::Closed));
    controller.forget_robot();
    let arm = arm();
    // One that only polls is asked, too.
    let simulator = SimulatorLink::open(settings, &arm).unwrap();
    assert_eq!(controller.wait_robot(SOON).unwrap().unwrap(), arm);
    simulator.publish(|observation| observation.sequence = 3).unwrap();
    assert!(matches!(controller.wait_observation(SOON).unwrap(), Wait::Message(seen) if seen.sequence == 3));
}

#[test]
fn a_robot_that_only_polls_says_its_interface_when_it_is_asked() {
    let (settings, _domain) = domain("polls");
    let format = arm();
    let simulator = SimulatorLink::open(settings.clone(), &format).unwrap();
    let controller = ControllerLink::open(settings, anything).unwrap();
    assert!(simulator.poll_action().unwrap().is_none());
    assert_eq!(controller.wait_robot(SOON).unwrap().unwrap(), format);
    controller.hello().unwrap();
    simulator.poll_action().unwrap();
    assert!(simulator.poll_events().unwrap().hello, "what was not asked for is kept");
}

#[test]
fn another_version_of_the_wire_is_named() {
    let (settings, _domain) = domain("wire");
    let node = make_node(&settings).unwrap();
    let name = format!("rcwm/{}/interface", settings.instance);
    let name = name.as_str().try_into().unwrap();
    let data = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<()>();
    let newer =
        AttributeSpecifier::new().define(&"rcwm.wire".try_into().unwrap(), &"3".try_into().unwrap()).unwrap();
    let _newer = data.history_size(1).subscriber_max_buffer_size(1).create_with_attributes(&newer).unwrap();
    let error = ControllerLink::open(settings.clone(), anything).err().unwrap();
    assert!(matches!(error, LinkError::OtherWire { .. }), "{error}");
    let error = SimulatorLink::open(settings, &arm()).err().unwrap();
    assert!(matches!(error, LinkError::OtherWire { .. }), "{error}");
}

#[test]
fn names_that_shared_memory_cannot_carry_are_refused() {
    let (settings, _domain) = domain("names");
    let format = Format::metaworld();
    for instance in ["", "a/b", "..", "with space"] {
        let settings = LinkSettings { instance: instance.into(), ..settings.clone() };
        let opened = SimulatorLink::open(settings, &format);
        assert!(matches!(opened, Err(LinkError::InstanceName(_))), "{instance:?}");
    }
    let settings = LinkSettings { prefix: Some("a/b".into()), ..settings };
    assert!(matches!(SimulatorLink::open(settings, &format), Err(LinkError::Prefix(_))));
}
