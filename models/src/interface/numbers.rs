//! The numbers of an action one by one, as whoever executes or sends them looks at them.

use super::{Action, ActionMode, Fallback, FallbackRule, Interface};

/// What a number of an action is where there is no decision.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Safe {
    /// The position that was commanded last.
    #[default]
    Hold,
    /// What was measured last.
    HoldMeasured,
    /// This, in units.
    Number(f32),
}

/// One number of an action; all in the interface's units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionNumber {
    pub low: f32,
    pub high: f32,
    /// Largest change from one action to the next; infinite where there is none.
    pub rate_max: f32,
    /// It is a position, of which zero is one like any other.
    pub is_absolute: bool,
    pub safe: Safe,
    /// Where among the measured numbers it is measured.
    pub measured: Option<usize>,
}

impl Interface {
    /// Every number of an action, in the order of the wire.
    #[must_use]
    pub fn numbers(&self) -> Vec<ActionNumber> {
        let of = |action: &Action| {
            let measured = action.measured.as_deref().and_then(|name| self.state_range(name));
            let is_absolute = action.mode == ActionMode::Absolute;
            let number = |at: usize| ActionNumber {
                low: action.low[at] as f32,
                high: action.high[at] as f32,
                rate_max: action.rate_max.map_or(f32::INFINITY, |most| most as f32),
                is_absolute,
                safe: match &action.fallback {
                    Fallback::Rule(FallbackRule::Hold) if is_absolute => Safe::Hold,
                    // The last change, once more, would move on: a robot that holds changes as little as it can.
                    Fallback::Rule(FallbackRule::Hold) => {
                        Safe::Number(0.0_f32.clamp(action.low[at] as f32, action.high[at] as f32))
                    }
                    Fallback::Rule(FallbackRule::HoldMeasured) => Safe::HoldMeasured,
                    Fallback::Rule(FallbackRule::Zero) => Safe::Number(0.0),
                    Fallback::Numbers(numbers) => Safe::Number(numbers[at] as f32),
                },
                measured: measured.as_ref().map(|range| range.start + at),
            };
            (0..action.elements.len()).map(number).collect::<Vec<_>>()
        };
        self.action.iter().flat_map(of).collect()
    }
}
