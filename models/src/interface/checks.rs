//! What makes an interface one that a robot can be run by.

use std::collections::BTreeSet;

use super::{Action, ActionMode, Camera, Fallback, FallbackRule, Interface, InterfaceError, State};

/// Bounds of what a message may hold: generous for robots, small enough that no text makes a reader take gigabytes.
const GROUPS_MAX: usize = 64;
const ELEMENTS_MAX: usize = 1024;
const SIDE_MAX: usize = 4096;
const NAME_MAX: usize = 64;
const OBSERVATION_BYTES_MAX: usize = 256 << 20;
/// Most numbers that all actions have together.
pub const ACTION_NUMBERS_MAX: usize = 64;
/// Most cameras.
pub const CAMERAS_MAX: usize = 8;
const RATES_HZ: std::ops::RangeInclusive<f64> = 0.001..=10_000.0;

type Checked = Result<(), InterfaceError>;

fn invalid(place: &str, found: impl Into<String>, expected: &str) -> Checked {
    Err(InterfaceError::Invalid {
        place: place.to_owned(),
        found: found.into(),
        expected: format!("expected {expected}"),
    })
}

impl Interface {
    pub(crate) fn check(&self) -> Checked {
        check_name("name", &self.name)?;
        if !RATES_HZ.contains(&self.rate_hz) {
            let found = format!("rate_hz = {}", self.rate_hz);
            return invalid(&self.name, found, "decisions a second, from 0.001 to 10000");
        }
        let groups = self.state.len() + self.camera.len() + self.action.len();
        if groups > GROUPS_MAX {
            let expected = format!("at most {GROUPS_MAX}");
            return invalid(&self.name, format!("{groups} states, cameras and actions"), &expected);
        }
        if self.camera.len() > CAMERAS_MAX {
            let expected = format!("at most {CAMERAS_MAX}");
            return invalid(&self.name, format!("{} cameras", self.camera.len()), &expected);
        }
        let numbers = self.action_numbers();
        if numbers > ACTION_NUMBERS_MAX {
            let expected = format!("at most {ACTION_NUMBERS_MAX}");
            return invalid(&self.name, format!("{numbers} numbers of all actions together"), &expected);
        }
        if self.action.is_empty() {
            return invalid(
                &self.name,
                "no [[interface.action]]",
                "at least one: what the controller commands",
            );
        }
        let inputs = self.state.iter().map(|state| &state.name);
        let inputs = inputs.chain(self.camera.iter().map(|camera| &camera.name));
        check_unique("states and cameras", inputs)?;
        check_unique("actions", self.action.iter().map(|action| &action.name))?;
        self.state.iter().try_for_each(State::check)?;
        self.camera.iter().try_for_each(Camera::check)?;
        self.action.iter().try_for_each(|action| action.check(&self.state))?;
        let bytes = super::Layout::of(self).observation_bytes;
        if bytes > OBSERVATION_BYTES_MAX {
            let expected = format!("at most {OBSERVATION_BYTES_MAX}");
            return invalid(&self.name, format!("an observation of {bytes} bytes"), &expected);
        }
        Ok(())
    }
}

impl State {
    fn check(&self) -> Checked {
        check_name("state", &self.name)?;
        let place = format!("state {}", self.name);
        check_kind(&place, &self.kind, "state/")?;
        check_unit(&place, &self.unit)?;
        check_elements(&place, &self.elements)
    }
}

impl Camera {
    fn check(&self) -> Checked {
        check_name("camera", &self.name)?;
        let place = format!("camera {}", self.name);
        let [rows, columns, channels] = self.shape;
        let sides = 1..=SIDE_MAX;
        if !sides.contains(&rows) || !sides.contains(&columns) || channels != 3 {
            let expected = format!("[rows, columns, 3] with sides of 1 to {SIDE_MAX}");
            return invalid(&place, format!("shape = {:?}", self.shape), &expected);
        }
        Ok(())
    }
}

impl Action {
    fn check(&self, states: &[State]) -> Checked {
        check_name("action", &self.name)?;
        let place = format!("action {}", self.name);
        if self.kind.split('/').any(|word| word == "discrete") {
            return invalid(&place, format!("kind = {:?}", self.kind), "a continuous action");
        }
        check_kind(&place, &self.kind, "command/")?;
        check_unit(&place, &self.unit)?;
        check_elements(&place, &self.elements)?;
        self.check_numbers(&place, "low", &self.low)?;
        self.check_numbers(&place, "high", &self.high)?;
        for ((low, high), element) in self.low.iter().zip(&self.high).zip(&self.elements) {
            if *low as f32 >= *high as f32 {
                let found = format!("{element} from {low} to {high}");
                return invalid(&place, found, "low below high");
            }
        }
        if let Some(most) = self.rate_max.filter(|most| !((*most as f32).is_finite() && *most as f32 > 0.0)) {
            let expected = "a change above 0 from one decision to the next, or none";
            return invalid(&place, format!("rate_max = {most}"), expected);
        }
        self.check_fallback(&place, states)
    }

    fn check_numbers(&self, place: &str, key: &str, numbers: &[f64]) -> Checked {
        let count = self.elements.len();
        if numbers.len() != count {
            let found = format!("{} numbers in {key}", numbers.len());
            return invalid(place, found, &format!("{count}, one for each element"));
        }
        // Numbers travel as f32.
        match numbers.iter().position(|x| !(*x as f32).is_finite()) {
            Some(at) => {
                let found = format!("{key} of {} is {}", self.elements[at], numbers[at]);
                invalid(place, found, "a finite number")
            }
            None => Ok(()),
        }
    }

    fn check_fallback(&self, place: &str, states: &[State]) -> Checked {
        let rule = match &self.fallback {
            Fallback::Rule(rule) => *rule,
            Fallback::Numbers(numbers) => {
                self.check_numbers(place, "fallback", numbers)?;
                let outside = |at: &usize| !(self.low[*at]..=self.high[*at]).contains(&numbers[*at]);
                return match (0..numbers.len()).find(outside) {
                    Some(at) => {
                        let found = format!("fallback of {} is {}", self.elements[at], numbers[at]);
                        let (low, high) = (self.low[at], self.high[at]);
                        invalid(place, found, &format!("a number within its limits, {low} to {high}"))
                    }
                    None => self.check_measured(place, states),
                };
            }
        };
        let relative = self.mode != ActionMode::Absolute;
        match rule {
            FallbackRule::Zero if !relative => invalid(
                place,
                "fallback = \"zero\" of a command that is absolute: zeros are a place to drive to",
                "hold, hold-measured or numbers",
            ),
            FallbackRule::Zero
                if self.low.iter().zip(&self.high).any(|(low, high)| *low > 0.0 || *high < 0.0) =>
            {
                invalid(
                    place,
                    "fallback = \"zero\" beyond the limits",
                    "limits on both sides of 0, or numbers",
                )
            }
            FallbackRule::HoldMeasured if relative => invalid(
                place,
                format!("fallback = \"hold-measured\" of a command that is a {}", self.mode.name()),
                "zero: what is measured is no change",
            ),
            FallbackRule::HoldMeasured if self.measured.is_none() => invalid(
                place,
                "fallback = \"hold-measured\" without measured",
                "measured = the name of a state",
            ),
            _ => self.check_measured(place, states),
        }
    }

    fn check_measured(&self, place: &str, states: &[State]) -> Checked {
        let Some(measured) = &self.measured else { return Ok(()) };
        let kind = |kind: &str| kind.split_once('/').map(|(_, rest)| rest.to_owned());
        let Some(state) = states.iter().find(|state| state.name == *measured) else {
            return invalid(place, format!("measured = {measured:?}"), "the name of a state");
        };
        if state.elements != self.elements {
            let expected = "the action's own elements, in their order";
            return invalid(place, format!("measured {measured} has other elements"), expected);
        }
        if kind(&state.kind) != kind(&self.kind) {
            let found = format!("measured {measured} is a {}", state.kind);
            return invalid(place, found, &format!("the same kind as the action's {}", self.kind));
        }
        if state.unit != self.unit {
            let found = format!("measured {measured} is in {}", state.unit);
            return invalid(place, found, &format!("the action's unit, {}", self.unit));
        }
        Ok(())
    }
}

fn check_unique<'a>(of: &str, names: impl Iterator<Item = &'a String>) -> Checked {
    let mut known = BTreeSet::new();
    for name in names {
        if !known.insert(name) {
            return invalid(of, format!("{name:?} twice"), "every name once");
        }
    }
    Ok(())
}

fn is_word(text: &str, also: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || also.contains(c);
    !text.is_empty() && text.len() <= NAME_MAX && text.chars().all(allowed)
}

fn check_name(place: &str, name: &str) -> Checked {
    if is_word(name, "_-.") {
        return Ok(());
    }
    let expected = format!("1 to {NAME_MAX} letters, digits, '_', '-' or '.'");
    invalid(place, format!("the name {name:?}"), &expected)
}

fn check_kind(place: &str, kind: &str, begin: &str) -> Checked {
    let words = kind.strip_prefix(begin).map(|rest| rest.split('/').all(|word| is_word(word, "_-")));
    if words == Some(true) && kind.len() <= NAME_MAX {
        return Ok(());
    }
    invalid(
        place,
        format!("kind = {kind:?}"),
        &format!("words after {begin:?}, for example {begin}joint/position"),
    )
}

fn check_unit(place: &str, unit: &str) -> Checked {
    if is_word(unit, "/^-%.*") {
        return Ok(());
    }
    invalid(place, format!("unit = {unit:?}"), "for example rad, m/s or N; 1 for what has none")
}

fn check_elements(place: &str, elements: &[String]) -> Checked {
    if elements.is_empty() || elements.len() > ELEMENTS_MAX {
        let expected = format!("1 to {ELEMENTS_MAX}");
        return invalid(place, format!("{} elements", elements.len()), &expected);
    }
    elements.iter().try_for_each(|name| check_name(place, name))?;
    check_unique(&format!("elements of {place}"), elements.iter())
}
