//! One text for each interface, and its hash.

use std::fmt::Write;

use super::{Action, ActionMode, Camera, Encoding, Fallback, FallbackRule, Interface, Mask, State};
use crate::files::sha256_hex;

impl Interface {
    /// The interface as text in one form only: equal interfaces have equal texts, which [`Interface::parse`] reads again.
    #[must_use]
    pub fn canonical(&self) -> String {
        let mut text = String::new();
        let out = &mut text;
        line(out, "[interface]", &[("name", quoted(&self.name)), ("rate_hz", number(self.rate_hz))]);
        for State { name, kind, elements, unit } in &self.state {
            let values = [
                ("name", quoted(name)),
                ("kind", quoted(kind)),
                ("elements", list(elements, |name| quoted(name))),
                ("unit", quoted(unit)),
            ];
            line(out, "\n[[interface.state]]", &values);
        }
        for Camera { name, shape, encoding: Encoding::Rgb8, mask } in &self.camera {
            let values = [
                ("name", quoted(name)),
                ("shape", list(shape, usize::to_string)),
                ("encoding", quoted("rgb8")),
            ];
            line(out, "\n[[interface.camera]]", &values);
            if let Some(Mask::Robot) = mask {
                line(out, "", &[("mask", quoted("robot"))]);
            }
        }
        for action in &self.action {
            let Action { name, kind, elements, unit, low, high, .. } = action;
            let values = [
                ("name", quoted(name)),
                ("kind", quoted(kind)),
                ("mode", quoted(action.mode.name())),
                ("elements", list(elements, |name| quoted(name))),
                ("unit", quoted(unit)),
                ("low", list(low, |x| number(*x))),
                ("high", list(high, |x| number(*x))),
            ];
            line(out, "\n[[interface.action]]", &values);
            if let Some(most) = action.rate_max {
                line(out, "", &[("rate_max", number(most))]);
            }
            line(out, "", &[("fallback", action.fallback.text())]);
            if let Some(measured) = &action.measured {
                line(out, "", &[("measured", quoted(measured))]);
            }
        }
        text
    }

    /// The canonical text's SHA-256 in hexadecimal digits: peers with the same one agree on everything.
    #[must_use]
    pub fn hash(&self) -> String {
        sha256_hex(self.canonical().as_bytes())
    }
}

impl ActionMode {
    /// Its name in a text.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Absolute => "absolute",
            Self::Delta => "delta",
            Self::Velocity => "velocity",
        }
    }
}

impl Fallback {
    pub(super) fn text(&self) -> String {
        match self {
            Self::Rule(FallbackRule::Hold) => quoted("hold"),
            Self::Rule(FallbackRule::HoldMeasured) => quoted("hold-measured"),
            Self::Rule(FallbackRule::Zero) => quoted("zero"),
            Self::Numbers(numbers) => list(numbers, |x| number(*x)),
        }
    }
}

fn line(out: &mut String, head: &str, values: &[(&str, String)]) {
    if !head.is_empty() {
        let _ = writeln!(out, "{head}");
    }
    for (key, value) in values {
        let _ = writeln!(out, "{key} = {value}");
    }
}

/// Names have no characters that would need an escape: see `checks`.
fn quoted(text: &str) -> String {
    format!("\"{text}\"")
}

/// The shortest decimal number that reads as the same one, with a point or an exponent; -0 is 0.
fn number(x: f64) -> String {
    format!("{:?}", if x == 0.0 { 0.0 } else { x })
}

fn list<T>(values: &[T], text: impl Fn(&T) -> String) -> String {
    format!("[{}]", values.iter().map(text).collect::<Vec<_>>().join(", "))
}
