//! What a robot may be commanded, number by number.

use rcwm_models::bundle::Manifest;
use rcwm_models::interface::{ActionNumber, Safe};
use rcwm_models::wire::{ACTION_NUMBERS_MAX, ActionValues};

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
    /// Half of the interface's range.
    pub half_range: ActionValues,
    /// The interface's fallback.
    pub safe: [Safe; ACTION_NUMBERS_MAX],
}

impl ActionLimits {
    /// The limits of a bundle, whose loading has checked that they are finite and low < high.
    #[must_use]
    pub fn of(manifest: &Manifest) -> Self {
        let (limits, numbers) = (manifest.limits(), manifest.interface.numbers());
        let each = |of: fn(&ActionNumber) -> f32| numbers.iter().map(of).collect();
        let absolute = numbers.iter().enumerate().filter(|(_, number)| number.is_absolute);
        let mut safe = [Safe::default(); ACTION_NUMBERS_MAX];
        safe.iter_mut().zip(&numbers).for_each(|(to, number)| *to = number.safe);
        Self {
            low: limits.low.into_iter().collect(),
            high: limits.high.into_iter().collect(),
            rate_max: each(|number| number.rate_max),
            absolute: absolute.fold(0, |bits, (at, _)| bits | 1 << at),
            // In f64, where no range is infinitely wide.
            half_range: each(|number| (0.5 * (f64::from(number.high) - f64::from(number.low))) as f32),
            safe,
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
impl ActionLimits {
    /// Displacements within these limits, of an interface of -1 to 1 that holds.
    pub(crate) fn for_tests(low: [f32; 4], high: [f32; 4]) -> Self {
        Self {
            low: low.into(),
            high: high.into(),
            rate_max: [f32::INFINITY; 4].into(),
            absolute: 0,
            half_range: [1.0; 4].into(),
            safe: [Safe::Hold; ACTION_NUMBERS_MAX],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_action_leaves_the_limits() {
        let limits = ActionLimits::for_tests([-1.0, -0.5, 0.25, -1.0], [1.0, 0.5, 0.75, 1.0]);
        assert_eq!(limits.clamp([2.0, -2.0, 0.0, 0.5].into()), [1.0, -0.5, 0.25, 0.5]);
        let odd = limits.clamp([f32::INFINITY, f32::NEG_INFINITY, 0.5, f32::NAN].into());
        assert_eq!(odd[..3], [1.0, -0.5, 0.5]);
        assert!(odd[3].is_nan());
    }
}
