//! Where a policy and a robot do not fit.

use std::fmt;

use serde::Serialize;

use super::{Action, Camera, Interface, State};

/// One thing in which a robot differs from what a policy needs, as a line for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Mismatch {
    /// For example `action arm`.
    pub place: String,
    /// What differs, what the policy needs and what the robot has.
    pub text: String,
}

impl Mismatch {
    #[must_use]
    pub fn new(place: &str, text: impl Into<String>) -> Self {
        Self { place: place.to_owned(), text: text.into() }
    }

    /// That `what` differs, where it does.
    #[must_use]
    pub fn between(place: &str, what: &str, needed: &str, has: &str) -> Option<Self> {
        let text = || format!("{what}: the policy needs {needed}, the robot has {has}");
        (needed != has).then(|| Self::new(place, text()))
    }

    /// That decisions are made at another rate, where they are (Hz).
    #[must_use]
    pub fn of_rates(needed: f64, has: f64) -> Option<Self> {
        let text = || format!("the policy decides {needed} times a second, the robot asks {has} times");
        ((needed - has).abs() > 1e-6 * needed).then(|| Self::new("rate", text()))
    }
}

impl Camera {
    /// Rows, columns and channels in words.
    #[must_use]
    pub fn size(&self) -> String {
        self.shape.map(|side| side.to_string()).join(" x ")
    }
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.place, self.text)
    }
}

/// Everything in which `robot` differs from what a policy of the interface `policy` needs that reads these `inputs`, states and cameras by
/// name. Empty: they fit. Actions must be the same in all, since who gives other limits means another command; what the policy does not
/// read, the robot may offer.
#[must_use]
pub fn mismatches(policy: &Interface, inputs: &[&str], robot: &Interface) -> Vec<Mismatch> {
    let mut found = Vec::new();
    found.extend(Mismatch::of_rates(policy.rate_hz, robot.rate_hz));
    for input in inputs {
        let state = policy.state.iter().find(|state| state.name == *input);
        let camera = policy.camera.iter().find(|camera| camera.name == *input);
        match (state, camera) {
            (Some(state), _) => compare_state(&mut found, state, robot),
            (None, Some(camera)) => compare_camera(&mut found, camera, robot),
            (None, None) => {
                add(&mut found, input, "an input of the policy that its own interface does not have")
            }
        }
    }
    for action in &policy.action {
        match robot.action.iter().find(|other| other.name == action.name) {
            Some(other) => compare_action(&mut found, action, other),
            None => {
                missing(&mut found, "action", &action.name, robot.action.iter().map(|action| &*action.name))
            }
        }
    }
    for action in &robot.action {
        if policy.action.iter().all(|other| other.name != action.name) {
            let text = "the robot expects it, and the policy does not command it";
            add(&mut found, &format!("action {}", action.name), text);
        }
    }
    let names = |of: &Interface| of.action.iter().map(|action| action.name.clone()).collect::<Vec<_>>();
    let (needed, has) = (names(policy), names(robot));
    // An action's numbers go out one group after the other.
    if needed != has && needed.iter().all(|name| has.contains(name)) && needed.len() == has.len() {
        let text =
            format!("in another order: {} of the policy, {} of the robot", needed.join(", "), has.join(", "));
        add(&mut found, "actions", text);
    }
    found
}

fn add(found: &mut Vec<Mismatch>, place: &str, text: impl Into<String>) {
    found.push(Mismatch::new(place, text));
}

fn missing<'a>(found: &mut Vec<Mismatch>, what: &str, name: &str, offered: impl Iterator<Item = &'a str>) {
    let offered: Vec<&str> = offered.collect();
    let list = if offered.is_empty() { "none".to_owned() } else { offered.join(", ") };
    let like = offered.iter().map(|other| (strsim::jaro_winkler(name, other), *other));
    let like = like.filter(|(alike, _)| *alike > 0.8).max_by(|a, b| a.0.total_cmp(&b.0));
    let hint = like.map_or_else(String::new, |(_, other)| format!("; is it {other}?"));
    add(found, &format!("{what} {name}"), format!("the robot has no such {what}; it has {list}{hint}"));
}

fn compare_state(found: &mut Vec<Mismatch>, state: &State, robot: &Interface) {
    let Some(other) = robot.state.iter().find(|other| other.name == state.name) else {
        return missing(found, "state", &state.name, robot.state.iter().map(|state| &*state.name));
    };
    let place = format!("state {}", state.name);
    differs(found, &place, "kind", &state.kind, &other.kind);
    differs(found, &place, "unit", &state.unit, &other.unit);
    compare_elements(found, &place, &state.elements, &other.elements);
}

fn compare_camera(found: &mut Vec<Mismatch>, camera: &Camera, robot: &Interface) {
    let Some(other) = robot.camera.iter().find(|other| other.name == camera.name) else {
        return missing(found, "camera", &camera.name, robot.camera.iter().map(|camera| &*camera.name));
    };
    let place = format!("camera {}", camera.name);
    differs(found, &place, "size", &camera.size(), &other.size());
    differs(found, &place, "encoding", &format!("{:?}", camera.encoding), &format!("{:?}", other.encoding));
}

fn compare_action(found: &mut Vec<Mismatch>, action: &Action, other: &Action) {
    let place = format!("action {}", action.name);
    differs(found, &place, "kind", &action.kind, &other.kind);
    differs(found, &place, "mode", action.mode.name(), other.mode.name());
    differs(found, &place, "unit", &action.unit, &other.unit);
    if compare_elements(found, &place, &action.elements, &other.elements) {
        for (at, element) in action.elements.iter().enumerate() {
            let limits = |of: &Action| format!("{} to {}", of.low[at] + 0.0, of.high[at] + 0.0);
            differs(found, &place, &format!("limits of {element}"), &limits(action), &limits(other));
        }
    }
    let rate = |of: &Action| of.rate_max.map_or_else(|| "none".to_owned(), |most| most.to_string());
    differs(found, &place, "rate_max", &rate(action), &rate(other));
    differs(found, &place, "fallback", &action.fallback.text(), &other.fallback.text());
    let measured = |of: &Action| of.measured.clone().unwrap_or_else(|| "none".to_owned());
    differs(found, &place, "measured", &measured(action), &measured(other));
}

fn differs(found: &mut Vec<Mismatch>, place: &str, what: &str, needed: &str, has: &str) {
    found.extend(Mismatch::between(place, what, needed, has));
}

/// Whether both have the same elements in the same order.
fn compare_elements(found: &mut Vec<Mismatch>, place: &str, needed: &[String], has: &[String]) -> bool {
    if needed == has {
        return true;
    }
    let lacks = |of: &[String], name: &String| !of.contains(name);
    let only = |these: &[String], of: &[String]| -> Vec<String> {
        these.iter().filter(|name| lacks(of, name)).cloned().collect()
    };
    let (missing, unknown) = (only(needed, has), only(has, needed));
    if !missing.is_empty() {
        add(found, place, format!("the robot has no {}", missing.join(", ")));
    }
    if !unknown.is_empty() {
        add(
            found,
            place,
            format!("the robot has {} too, which the policy does not know", unknown.join(", ")),
        );
    }
    if missing.is_empty() && unknown.is_empty() {
        let at = needed.iter().zip(has).position(|(a, b)| a != b).unwrap_or_default();
        let text = format!(
            "in another order: number {} is {} of the policy, {} of the robot",
            at + 1,
            needed[at],
            has[at]
        );
        add(found, place, text);
    }
    false
}
