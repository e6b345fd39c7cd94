//! What the messages of one interface look like.

use std::sync::Arc;

use super::ActionValues;
use crate::interface::{Interface, Layout, Normaliser};

/// By how much of its range a robot may report more than a limit allows as executed: it may have rounded.
const EXECUTED_ROUNDING: f32 = 5e-4;

/// An interface with all that its messages need to be read and checked.
#[derive(Debug, PartialEq)]
pub struct Format {
    interface: Interface,
    layout: Layout,
    hash: String,
    low: ActionValues,
    high: ActionValues,
    normaliser: Normaliser,
}

impl Format {
    #[must_use]
    pub fn of(interface: Interface) -> Arc<Self> {
        let numbers = interface.numbers();
        let low = numbers.iter().map(|number| number.low).collect();
        let high = numbers.iter().map(|number| number.high).collect();
        let (layout, normaliser) = (Layout::of(&interface), Normaliser::of(&interface));
        Arc::new(Self { layout, hash: interface.hash(), low, high, normaliser, interface })
    }

    /// That of Meta-World's arm.
    #[must_use]
    pub fn metaworld() -> Arc<Self> {
        Self::of(Interface::metaworld())
    }

    #[must_use]
    pub fn interface(&self) -> &Interface {
        &self.interface
    }

    #[must_use]
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// See [`Interface::hash`].
    #[must_use]
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Numbers of an action.
    #[must_use]
    pub fn action_numbers(&self) -> usize {
        self.low.len()
    }

    /// An action of zeros.
    #[must_use]
    pub fn zeros(&self) -> ActionValues {
        ActionValues::zeros(self.action_numbers())
    }

    /// What moves a robot least whose actions are displacements or velocities: zeros, or what is nearest to them within the limits.
    #[must_use]
    pub fn rest(&self) -> ActionValues {
        ActionValues::from_fn(self.action_numbers(), |at| 0.0_f32.clamp(self.low[at], self.high[at]))
    }

    /// Actions in units, and in [-1, 1] as models and episodes have them.
    #[must_use]
    pub fn normaliser(&self) -> &Normaliser {
        &self.normaliser
    }

    /// Whether a robot may execute this action: as many numbers as the interface has, each finite and within its limits.
    #[must_use]
    pub fn is_within_limits(&self, action: &[f32]) -> bool {
        self.is_near_limits(action, 0.0)
    }

    /// Whether a robot can have executed this action: within the limits but for rounding.
    #[must_use]
    pub fn is_executable(&self, action: &[f32]) -> bool {
        self.is_near_limits(action, EXECUTED_ROUNDING)
    }

    fn is_near_limits(&self, action: &[f32], beyond: f32) -> bool {
        let limits = self.low.iter().zip(self.high.iter());
        // NaN is within nothing.
        let fits = |(x, (low, high)): (&f32, (&f32, &f32))| {
            // In f64, where no range is infinitely wide.
            let (x, low, high) = (f64::from(*x), f64::from(*low), f64::from(*high));
            let beyond = f64::from(beyond) * (high - low);
            low - beyond <= x && x <= high + beyond
        };
        action.len() == self.low.len() && action.iter().zip(limits).all(fits)
    }
}
