//! The topics of a robot: one a camera, a mask, a state and an action, as its interface says.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::ops::Range;
use std::sync::Arc;

use rcwm_models::interface::{Action, ActionMode, State};
use rcwm_models::wire::{Format, Observation};

use super::bag::Bag;
use super::file::{Properties, Times};
use super::messages::{JointField, Schema, image, joint_state, numbers};

/// The channels of a robot.
pub(super) struct Robot {
    format: Arc<Format>,
    cameras: Vec<u16>,
    /// One a camera; none where it has no mask.
    masks: Vec<Option<u16>>,
    states: Vec<Group>,
    executed: Vec<Group>,
    sent: Vec<Group>,
}

/// Numbers that are one message.
struct Group {
    channel: u16,
    /// Which of all numbers.
    range: Range<usize>,
    elements: Vec<String>,
    /// None: no joint's.
    joint: Option<JointField>,
}

impl Robot {
    /// Adds the channels of a robot.
    pub(super) fn start<W: Write>(bag: &mut Bag<W>, format: &Arc<Format>) -> Self {
        let interface = format.interface();
        let (mut cameras, mut masks) = (Vec::new(), Vec::new());
        let names = interface.camera.iter().map(|camera| &camera.name);
        for (camera, topic) in interface.camera.iter().zip(topics(names)) {
            let properties = Properties::from([("name".to_owned(), camera.name.clone())]);
            cameras.push(bag.channel(&format!("/rcwm/camera/{topic}"), Schema::Image, &properties));
            let mask =
                camera.mask.map(|_| bag.channel(&format!("/rcwm/mask/{topic}"), Schema::Image, &properties));
            masks.push(mask);
        }
        let states: Vec<_> = interface.state.iter().map(of_state).collect();
        let actions: Vec<_> = interface.action.iter().map(of_action).collect();
        Self {
            format: Arc::clone(format),
            cameras,
            masks,
            states: groups(bag, "state", &states),
            executed: groups(bag, "executed", &actions),
            sent: groups(bag, "action", &actions),
        }
    }

    pub(super) fn format(&self) -> &Arc<Format> {
        &self.format
    }

    /// Writes what was seen and measured, and the action that was executed; `captured_ns` are the times of the pictures.
    pub(super) fn observed<W: Write>(
        &self,
        bag: &mut Bag<W>,
        times: Times,
        captured_ns: &[u64],
        observation: &Observation<'_>,
    ) -> io::Result<()> {
        for (at, camera) in self.format.interface().camera.iter().enumerate() {
            let [rows, columns, _] = camera.shape;
            let message = |data| image(captured_ns[at], &camera.name, [rows, columns], data);
            bag.write(self.cameras[at], times, &message(observation.image(at)))?;
            if let (Some(channel), Some(mask)) = (self.masks[at], observation.mask(at)) {
                bag.write(channel, times, &message(mask))?;
            }
        }
        write(bag, &self.states, times, observation.state())?;
        write(bag, &self.executed, times, observation.executed())
    }

    /// Writes what was sent.
    pub(super) fn sent<W: Write>(&self, bag: &mut Bag<W>, times: Times, action: &[f32]) -> io::Result<()> {
        write(bag, &self.sent, times, action)
    }
}

fn write<W: Write>(bag: &mut Bag<W>, groups: &[Group], times: Times, all: &[f32]) -> io::Result<()> {
    for Group { channel, range, elements, joint } in groups {
        let values = &all[range.clone()];
        let message = match joint {
            Some(field) => joint_state(times.publish_ns, elements, *field, values),
            None => numbers(&elements.join(","), values),
        };
        bag.write(*channel, times, &message)?;
    }
    Ok(())
}

/// A state or an action: its name, its elements, what it is of a joint, and its properties.
struct Described<'a> {
    name: &'a String,
    elements: &'a [String],
    joint: Option<JointField>,
    properties: Properties,
}

fn of_state(state: &State) -> Described<'_> {
    let State { name, kind, elements, unit } = state;
    let properties = [("kind", kind.clone()), ("unit", unit.clone())];
    described(name, elements, joint_field(kind, unit), properties)
}

fn of_action(action: &Action) -> Described<'_> {
    let Action { name, kind, mode, elements, unit, low, high, .. } = action;
    // A displacement is no position.
    let joint = joint_field(kind, unit).filter(|_| *mode != ActionMode::Delta);
    let row = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
    let properties = [
        ("kind", kind.clone()),
        ("unit", unit.clone()),
        ("mode", mode.name().to_owned()),
        ("low", row(low)),
        ("high", row(high)),
    ];
    described(name, elements, joint, properties)
}

fn described<'a, const N: usize>(
    name: &'a String,
    elements: &'a [String],
    joint: Option<JointField>,
    properties: [(&str, String); N],
) -> Described<'a> {
    let own = [("name", name.clone()), ("elements", elements.join(","))];
    let all = own.into_iter().chain(properties).map(|(key, value)| (key.to_owned(), value)).collect();
    Described { name, elements, joint, properties: all }
}

/// What of a joint these numbers are, where they are in the units that ROS has for it.
fn joint_field(kind: &str, unit: &str) -> Option<JointField> {
    let (_, what) = kind.split_once("/joint/")?;
    match (what, unit) {
        ("position", "rad" | "m") => Some(JointField::Position),
        ("velocity", "rad/s" | "m/s") => Some(JointField::Velocity),
        ("effort", "N" | "N*m" | "N.m" | "Nm") => Some(JointField::Effort),
        _ => None,
    }
}

fn groups<W: Write>(bag: &mut Bag<W>, folder: &str, described: &[Described<'_>]) -> Vec<Group> {
    let mut from = 0;
    let names = topics(described.iter().map(|group| group.name));
    let group = |(Described { elements, joint, properties, .. }, topic): (&Described<'_>, String)| {
        let schema = if joint.is_some() { Schema::JointState } else { Schema::Numbers };
        let channel = bag.channel(&format!("/rcwm/{folder}/{topic}"), schema, properties);
        let range = from..from + elements.len();
        from = range.end;
        Group { channel, range, elements: elements.to_vec(), joint: *joint }
    };
    described.iter().zip(names).map(group).collect()
}

/// The names as ROS 2 takes them in a topic: letters, digits and single underscores, no digit first, each once.
fn topics<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let topic = |name: &String| {
        let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
        let mut topic = words.collect::<Vec<_>>().join("_");
        if !topic.starts_with(|c: char| c.is_ascii_alphabetic()) {
            topic.insert(0, 'n');
        }
        while !taken.insert(topic.clone()) {
            topic.push_str("_2");
        }
        topic
    };
    names.map(topic).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_topics_of_ros_each_once() {
        let names = ["front", "wrist-cam.left", "wrist_cam_left", "2nd", "_", "a__b-"].map(str::to_owned);
        let expected = ["front", "wrist_cam_left", "wrist_cam_left_2", "n2nd", "n", "a_b"];
        assert_eq!(topics(names.iter()), expected);
    }

    #[test]
    fn only_what_is_in_the_units_of_ros_is_a_joint_s() {
        assert_eq!(joint_field("state/joint/position", "rad"), Some(JointField::Position));
        assert_eq!(joint_field("command/joint/velocity", "m/s"), Some(JointField::Velocity));
        for (kind, unit) in
            [("state/joint/position", "1"), ("state/joint/position", "deg"), ("state/hand/position", "m")]
        {
            assert_eq!(joint_field(kind, unit), None, "{kind} {unit}");
        }
    }
}
