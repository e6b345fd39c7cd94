//! The last thing that happens to an action.

use rcwm_models::bundle::{ActionMode, Manifest};
use rcwm_models::wire::ActionValues;

/// What each number of an action may be, in the interface's units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionLimits {
    /// Smallest values.
    pub low: ActionValues,
    /// Largest values.
    pub high: ActionValues,
    /// Largest change from one action to the next; infinite where there is no limit.
    pub rate_max: ActionValues,
    /// One bit a number: it is a position, of which zero is one like any other.
    pub absolute: u64,
}

impl ActionLimits {
    /// The limits of a bundle, whose loading has checked that they are finite and low < high.
    #[must_use]
    pub fn of(manifest: &Manifest) -> Self {
        let limits = manifest.limits();
        let actions = &manifest.interface.action;
        let each = actions.iter().flat_map(|action| std::iter::repeat_n(action, action.elements.len()));
        let rate_max = |most: Option<f64>| most.map_or(f32::INFINITY, |most| most as f32);
        let absolute = each.clone().enumerate().filter(|(_, action)| action.mode == ActionMode::Absolute);
        Self {
            low: limits.low.into_iter().collect(),
            high: limits.high.into_iter().collect(),
            rate_max: each.map(|action| rate_max(action.rate_max)).collect(),
            absolute: absolute.fold(0, |bits, (at, _)| bits | 1 << at),
        }
    }

    /// Numbers of an action.
    #[must_use]
    pub fn numbers(&self) -> usize {
        self.low.len()
    }

    /// Whether this number is a position.
    #[must_use]
    pub fn is_absolute(&self, at: usize) -> bool {
        self.absolute >> at & 1 == 1
    }

    /// The nearest action within the limits. A component that is no number stays none: no action is nearest to it.
    #[must_use]
    pub fn clamp(&self, action: ActionValues) -> ActionValues {
        ActionValues::from_fn(action.len(), |i| action[i].clamp(self.low[i], self.high[i]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_action_leaves_the_limits() {
        let limits = ActionLimits {
            low: [-1.0, -0.5, 0.25, -1.0].into(),
            high: [1.0, 0.5, 0.75, 1.0].into(),
            rate_max: [f32::INFINITY; 4].into(),
            absolute: 0,
        };
        assert_eq!(limits.clamp([2.0, -2.0, 0.0, 0.5].into()), [1.0, -0.5, 0.25, 0.5]);
        let odd = limits.clamp([f32::INFINITY, f32::NEG_INFINITY, 0.5, f32::NAN].into());
        assert_eq!(odd[..3], [1.0, -0.5, 0.5]);
        assert!(odd[3].is_nan());
    }
}
