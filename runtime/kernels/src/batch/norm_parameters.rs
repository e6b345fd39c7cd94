//! Gain and shift of a normalisation, and their gradients.

use crate::vectorised;

/// What a normalisation is made of.
#[derive(Debug, Clone, Copy)]
pub struct Norm<'a> {
    /// Factor of each column, [width].
    pub gain: &'a [f32],
    /// Shift of each column, [width].
    pub shift: &'a [f32],
    /// Added to the variance.
    pub eps: f32,
    /// Whether `SiLU` follows.
    pub silu: bool,
}

/// Gradients of gain and shift, summed over rows.
#[derive(Debug, Clone)]
pub struct NormGrads {
    /// Of the gain, [width].
    pub gain: Vec<f32>,
    /// Of the shift, [width].
    pub shift: Vec<f32>,
}

impl NormGrads {
    /// Zeros.
    pub fn new(width: usize) -> Self {
        Self { gain: vec![0.0; width], shift: vec![0.0; width] }
    }

    /// The sum of the shares' sums, in their order.
    #[must_use]
    pub fn total(sums: Vec<Self>, width: usize) -> Self {
        sums.into_iter().fold(Self::new(width), |mut total, sum| {
            total.add(&sum);
            total
        })
    }

    /// Adds another sum.
    pub fn add(&mut self, other: &Self) {
        add(&mut self.gain, &other.gain);
        add(&mut self.shift, &other.shift);
    }
}

/// `sum += terms`.
pub fn add(sum: &mut [f32], terms: &[f32]) {
    vectorised(
        #[inline(always)]
        || {
            for (sum, term) in sum.iter_mut().zip(terms) {
                *sum += term;
            }
        },
    );
}
