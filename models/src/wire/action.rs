//! Actions: their numbers, and a controller's answer.

use std::fmt;
use std::ops::{Deref, DerefMut};

use serde::{Deserialize, Serialize};

pub use crate::interface::ACTION_NUMBERS_MAX;

/// The numbers of an action, at most [`ACTION_NUMBERS_MAX`], in the order of the interface and in its units. Lies where it is used:
/// copying one allocates nothing.
#[derive(Clone, Copy)]
pub struct ActionValues {
    len: usize,
    values: [f32; ACTION_NUMBERS_MAX],
}

impl ActionValues {
    /// # Panics
    /// With more than [`ACTION_NUMBERS_MAX`], which no interface has.
    #[must_use]
    pub fn zeros(len: usize) -> Self {
        assert!(len <= ACTION_NUMBERS_MAX, "an action of {len} numbers");
        Self { len, values: [0.0; ACTION_NUMBERS_MAX] }
    }

    /// One number for each of the places `0..len`.
    #[must_use]
    pub fn from_fn(len: usize, mut number: impl FnMut(usize) -> f32) -> Self {
        let mut all = Self::zeros(len);
        all.iter_mut().enumerate().for_each(|(at, x)| *x = number(at));
        all
    }

    /// These numbers; none where there are too many.
    #[must_use]
    pub fn of(numbers: &[f32]) -> Option<Self> {
        (numbers.len() <= ACTION_NUMBERS_MAX).then(|| Self::from_fn(numbers.len(), |at| numbers[at]))
    }

    /// The bits of each, for comparisons that tell -0 from 0.
    #[must_use]
    pub fn to_bits(&self) -> Vec<u32> {
        self.iter().map(|x| x.to_bits()).collect()
    }

    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.iter().all(|x| x.is_finite())
    }
}

impl Default for ActionValues {
    fn default() -> Self {
        Self::zeros(0)
    }
}

impl Deref for ActionValues {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        &self.values[..self.len]
    }
}

impl DerefMut for ActionValues {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.values[..self.len]
    }
}

impl PartialEq for ActionValues {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<const N: usize> PartialEq<[f32; N]> for ActionValues {
    fn eq(&self, other: &[f32; N]) -> bool {
        **self == *other
    }
}

impl<const N: usize> PartialEq<ActionValues> for [f32; N] {
    fn eq(&self, other: &ActionValues) -> bool {
        *self == **other
    }
}

impl IntoIterator for ActionValues {
    type Item = f32;
    type IntoIter = std::iter::Take<std::array::IntoIter<f32, ACTION_NUMBERS_MAX>>;
    fn into_iter(self) -> Self::IntoIter {
        self.values.into_iter().take(self.len)
    }
}

impl<'a> IntoIterator for &'a ActionValues {
    type Item = &'a f32;
    type IntoIter = std::slice::Iter<'a, f32>;
    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl fmt::Debug for ActionValues {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(f)
    }
}

impl<const N: usize> From<[f32; N]> for ActionValues {
    fn from(numbers: [f32; N]) -> Self {
        const { assert!(N <= ACTION_NUMBERS_MAX) };
        Self::from_fn(N, |at| numbers[at])
    }
}

impl FromIterator<f32> for ActionValues {
    /// # Panics
    /// With more than [`ACTION_NUMBERS_MAX`], which no interface has.
    fn from_iter<I: IntoIterator<Item = f32>>(numbers: I) -> Self {
        let mut all = Self::default();
        for number in numbers {
            assert!(all.len < ACTION_NUMBERS_MAX, "an action of more than {ACTION_NUMBERS_MAX} numbers");
            all.values[all.len] = number;
            all.len += 1;
        }
        all
    }
}

impl Serialize for ActionValues {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        (**self).serialize(to)
    }
}

impl<'de> Deserialize<'de> for ActionValues {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let numbers = Vec::<f32>::deserialize(from)?;
        let found = numbers.len();
        let too_many = || format!("{found} numbers of an action, at most {ACTION_NUMBERS_MAX} are possible");
        Self::of(&numbers).ok_or_else(|| serde::de::Error::custom(too_many()))
    }
}

/// Where an action came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum ActionSource {
    /// The policy, on the observation it answers.
    Policy = 0,
    /// The policy, on a state the world model imagined because the observation was missing.
    Imagined = 1,
    /// The configured fallback: the policy had nothing fit to send.
    Fallback = 2,
}

impl ActionSource {
    /// The source of a wire number, if it is one.
    #[must_use]
    pub const fn from_wire(number: u32) -> Option<Self> {
        match number {
            0 => Some(Self::Policy),
            1 => Some(Self::Imagined),
            2 => Some(Self::Fallback),
            _ => None,
        }
    }
}

/// A controller's answer to one observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Action {
    /// Sequence of the observation it answers.
    pub answers: u64,
    /// When it was published, CLOCK_MONOTONIC in nanoseconds.
    pub published_ns: u64,
    /// See [`ActionSource`].
    pub source: u32,
    /// In the units of the interface.
    pub action: ActionValues,
}
