//! What a robot offers and what a policy needs: states, cameras and actions with names, units, limits and a safe action.
//!
//! The same text is a robot's `robot.toml` and, later, part of bundles and episodes. [`Interface::parse`] reads and checks it,
//! [`Interface::canonical`] writes it in one form only, whose hash two peers compare; [`mismatches`] says where a policy and a robot
//! do not fit; [`Layout`] is where everything lies in a message; [`Normaliser`] maps actions to [-1, 1] and back.
//!
//! ```toml
//! [interface]
//! name = "arm7"
//! rate_hz = 50.0
//!
//! [[interface.state]]
//! name = "joint_pos"
//! kind = "state/joint/position"
//! elements = ["j1", "j2"]
//! unit = "rad"
//!
//! [[interface.camera]]
//! name = "front"
//! shape = [128, 128, 3]
//! encoding = "rgb8"
//!
//! [[interface.action]]
//! name = "arm"
//! kind = "command/joint/position"
//! mode = "absolute"
//! elements = ["j1", "j2"]
//! unit = "rad"
//! low = [-2.9, -1.7]
//! high = [2.9, 1.7]
//! fallback = "hold-measured"
//! measured = "joint_pos"
//! ```

mod canonical;
mod checks;
mod compare;
mod layout;
mod normalise;
mod numbers;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::files::{FileError, read_capped};

pub use checks::{ACTION_NUMBERS_MAX, CAMERAS_MAX};
pub use compare::{Mismatch, mismatches};
pub use layout::{Block, Layout};
pub use normalise::{Normaliser, NotFinite};
pub use numbers::{ActionNumber, Safe};

/// Everything that goes over the wire between a robot and its controller.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Interface {
    pub name: String,
    /// Decisions a second.
    pub rate_hz: f64,
    /// Measured vectors, in the order of the wire.
    #[serde(default)]
    pub state: Vec<State>,
    #[serde(default)]
    pub camera: Vec<Camera>,
    /// Commanded vectors, in the order of the wire.
    #[serde(default)]
    pub action: Vec<Action>,
}

/// A measured vector of f32.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct State {
    pub name: String,
    /// What it is, for example `state/joint/position`.
    pub kind: String,
    /// A name for each number.
    pub elements: Vec<String>,
    /// For example `rad`; `1` for what has none.
    pub unit: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    pub name: String,
    /// Rows, columns, channels.
    pub shape: [usize; 3],
    pub encoding: Encoding,
    /// What a mask shows that travels beside the picture, one byte a pixel; none: no mask.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<Mask>,
}

/// How a pixel is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Encoding {
    /// Red, green, blue, a byte each.
    Rgb8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mask {
    Robot,
}

/// A commanded vector of f32.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Action {
    pub name: String,
    /// What it is, for example `command/joint/position`.
    pub kind: String,
    pub mode: ActionMode,
    /// A name for each number.
    pub elements: Vec<String>,
    pub unit: String,
    /// Smallest value of each element, in units.
    pub low: Vec<f64>,
    /// Largest value of each element, in units.
    pub high: Vec<f64>,
    /// Largest change from one decision to the next, in units; none: any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_max: Option<f64>,
    /// What is commanded when there is no decision.
    pub fallback: Fallback,
    /// The state that this action moves, where the fallback holds what was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured: Option<String>,
}

/// What an action commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ActionMode {
    /// Displacements, as in Meta-World: zeros are no motion.
    #[default]
    Delta,
    /// Velocities: zeros are no motion.
    Velocity,
    /// Positions: zeros are a pose like any other, and rest is the position that is held.
    Absolute,
}

/// What is commanded when there is no decision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected fallback = \"hold\", \"hold-measured\", \"zero\" or a list of numbers"
)]
pub enum Fallback {
    Rule(FallbackRule),
    /// These numbers, in units.
    Numbers(Vec<f64>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FallbackRule {
    /// The last command again.
    Hold,
    /// What was measured last.
    HoldMeasured,
    /// Zeros; of what is relative only.
    Zero,
}

/// Why a text is no interface.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InterfaceError {
    #[error("no interface: {0}")]
    Syntax(String),
    /// A value that makes no sense, where it stands, and what is expected.
    #[error("interface: {place}: {found}; {expected}")]
    Invalid { place: String, found: String, expected: String },
}

/// Why a robot's file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum InterfaceFileError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: {source}", path.display())]
    Interface { path: PathBuf, source: InterfaceError },
}

/// Largest file of a robot accepted, in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// The file around an interface.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    interface: Interface,
    /// Of bundles alone: which of these a policy reads.
    #[serde(default, skip_serializing, rename = "policy")]
    _policy: Option<toml::Table>,
}

impl Interface {
    /// Reads and checks the text of a `robot.toml`. Beside `[interface]` it may have a bundle's `[policy]`, which is not read.
    ///
    /// # Errors
    /// [`InterfaceError`], which names the place.
    pub fn parse(text: &str) -> Result<Self, InterfaceError> {
        let syntax = |error: toml::de::Error| {
            let line = error.span().map(|span| text[..span.start.min(text.len())].lines().count().max(1));
            let place = line.map_or_else(String::new, |line| format!("line {line}: "));
            InterfaceError::Syntax(format!("{place}{}", error.message()))
        };
        let File { interface, .. } = toml::from_str(text).map_err(syntax)?;
        interface.check()?;
        Ok(interface)
    }

    /// Reads the file of a robot.
    ///
    /// # Errors
    /// [`InterfaceFileError`], which names the file.
    pub fn read(path: &Path) -> Result<Self, InterfaceFileError> {
        let bytes = read_capped(path, FILE_BYTES_MAX)?;
        let wrong = |source| InterfaceFileError::Interface { path: path.to_path_buf(), source };
        let text = String::from_utf8(bytes);
        let text = text.map_err(|_| wrong(InterfaceError::Syntax("not a text (UTF-8)".into())))?;
        Self::parse(&text).map_err(wrong)
    }

    /// The interface of Meta-World's arm, which messages of version 1 carry and bundles of version 1 need.
    #[must_use]
    pub fn metaworld() -> Self {
        Self::parse(include_str!("metaworld.toml")).expect("our own text is an interface")
    }

    /// Numbers of all actions together.
    #[must_use]
    pub fn action_numbers(&self) -> usize {
        self.action.iter().map(|action| action.elements.len()).sum()
    }

    /// Numbers of all states together.
    #[must_use]
    pub fn state_numbers(&self) -> usize {
        self.state.iter().map(|state| state.elements.len()).sum()
    }
}
