//! Actions in units, and as a policy has them: in [-1, 1].

use super::{Action, Interface};

/// Maps all actions of an interface, one after the other.
#[derive(Debug, Clone, PartialEq)]
pub struct Normaliser {
    low: Vec<f32>,
    high: Vec<f32>,
}

/// A number that is no number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("number {at} of the action is not finite")]
pub struct NotFinite {
    /// Which, from 0.
    pub at: usize,
}

impl Normaliser {
    #[must_use]
    pub fn of(interface: &Interface) -> Self {
        let all = |of: fn(&Action) -> &Vec<f64>| {
            interface.action.iter().flat_map(of).map(|x| *x as f32).collect::<Vec<f32>>()
        };
        Self { low: all(|action| &action.low), high: all(|action| &action.high) }
    }

    /// An action of [-1, 1] in units; what lies beyond is at the limit.
    ///
    /// # Errors
    /// [`NotFinite`]; `units` is then as it was.
    pub fn to_units(&self, action: &[f32], units: &mut [f32]) -> Result<(), NotFinite> {
        finite(action)?;
        for (((to, x), low), high) in units.iter_mut().zip(action).zip(&self.low).zip(&self.high) {
            // In f64, where neither the width nor the sum can overflow or miss an end. Limits of -1 and 1 change no bit.
            let (low, high) = (f64::from(*low), f64::from(*high));
            let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
            *to = (middle + half * f64::from(*x)).clamp(low, high) as f32;
        }
        Ok(())
    }

    /// An action in units as one of [-1, 1]; what lies beyond the limits is at an end.
    ///
    /// # Errors
    /// [`NotFinite`]; `action` is then as it was.
    pub fn from_units(&self, units: &[f32], action: &mut [f32]) -> Result<(), NotFinite> {
        finite(units)?;
        for (((to, x), low), high) in action.iter_mut().zip(units).zip(&self.low).zip(&self.high) {
            let (low, high) = (f64::from(*low), f64::from(*high));
            let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
            *to = ((f64::from(*x) - middle) / half).clamp(-1.0, 1.0) as f32;
        }
        Ok(())
    }
}

fn finite(numbers: &[f32]) -> Result<(), NotFinite> {
    match numbers.iter().position(|x| !x.is_finite()) {
        Some(at) => Err(NotFinite { at }),
        None => Ok(()),
    }
}
