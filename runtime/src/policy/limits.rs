//! The last thing that happens to an action.

use rcwm_models::ACTION_LEN;
use rcwm_models::bundle::Control;

/// The range of each action component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionLimits {
    /// Smallest values.
    pub low: [f32; ACTION_LEN],
    /// Largest values.
    pub high: [f32; ACTION_LEN],
}

impl ActionLimits {
    /// The limits of a bundle, whose loading has checked that they are finite and low < high.
    #[must_use]
    pub fn of(control: &Control) -> Self {
        let fixed = |limits: &[f32]| std::array::from_fn(|i| limits.get(i).copied().unwrap_or_default());
        Self { low: fixed(&control.action_low), high: fixed(&control.action_high) }
    }

    /// The nearest action within the limits. A component that is no number stays none: no action is nearest to it.
    #[must_use]
    pub fn clamp(&self, action: [f32; ACTION_LEN]) -> [f32; ACTION_LEN] {
        std::array::from_fn(|i| action[i].clamp(self.low[i], self.high[i]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_action_leaves_the_limits() {
        let limits = ActionLimits { low: [-1.0, -0.5, 0.25, -1.0], high: [1.0, 0.5, 0.75, 1.0] };
        assert_eq!(limits.clamp([2.0, -2.0, 0.0, 0.5]), [1.0, -0.5, 0.25, 0.5]);
        let odd = limits.clamp([f32::INFINITY, f32::NEG_INFINITY, 0.5, f32::NAN]);
        assert_eq!(odd[..3], [1.0, -0.5, 0.5]);
        assert!(odd[3].is_nan());
    }
}
