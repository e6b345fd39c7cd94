//! The categorical latents: log-probabilities, classes and divergence.

use pulp::{Arch, Simd, WithSimd};

use crate::simd::{exp, ln};

/// `x` [rows, classes], logits, becomes `ln(factor * softmax(x) + offset)` in place (`offset` is the share of the uniform distribution that is mixed in).
///
/// # Panics
/// If `x` is not whole rows: a programming error.
pub fn log_probs(arch: Arch, x: &mut [f32], classes: usize, factor: f32, offset: f32) {
    assert_eq!(x.len() % classes, 0, "log_probs: {} numbers in rows of {classes}", x.len());
    arch.dispatch(LogProbs { x, classes, factor, offset });
}

struct LogProbs<'a> {
    x: &'a mut [f32],
    classes: usize,
    factor: f32,
    offset: f32,
}

impl WithSimd for LogProbs<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { x, classes, factor, offset } = self;
        let offset = simd.splat_f32s(offset);
        for row in x.chunks_exact_mut(classes) {
            let largest = simd.splat_f32s(largest(simd, row));
            let sum = exponentials(simd, row, largest);
            let factor = simd.splat_f32s(factor / sum);
            // Closures would not be compiled for vectors unless they are taken in here.
            each(
                simd,
                row,
                #[inline(always)]
                |simd, x| ln(simd, simd.mul_add_f32s(x, factor, offset)),
            );
        }
    }
}

/// The largest number; may forget NaN, which the sum of exponentials does not.
#[inline(always)]
fn largest<S: Simd>(simd: S, row: &[f32]) -> f32 {
    let (whole, rest) = S::as_simd_f32s(row);
    let mut lanes = simd.splat_f32s(f32::NEG_INFINITY);
    for x in whole {
        lanes = simd.max_f32s(*x, lanes);
    }
    rest.iter().copied().fold(simd.reduce_max_f32s(lanes), f32::max)
}

/// `x` becomes `e^(x - largest)`; gives the sum.
#[inline(always)]
fn exponentials<S: Simd>(simd: S, row: &mut [f32], largest: S::f32s) -> f32 {
    each(
        simd,
        row,
        #[inline(always)]
        |simd, x| exp(simd, simd.sub_f32s(x, largest)),
    );
    let (whole, rest) = S::as_simd_f32s(row);
    let mut sum = simd.splat_f32s(0.0);
    for x in whole {
        sum = simd.add_f32s(sum, *x);
    }
    simd.reduce_sum_f32s(sum) + rest.iter().sum::<f32>()
}

/// Applies a function to every number.
#[inline(always)]
fn each<S: Simd>(simd: S, x: &mut [f32], function: impl Fn(S, S::f32s) -> S::f32s) {
    let (whole, rest) = S::as_mut_simd_f32s(x);
    for x in whole {
        *x = function(simd, *x);
    }
    if !rest.is_empty() {
        // What is not there is 0 and is not stored; 1 keeps a logarithm of it quiet.
        let value = simd.partial_load_f32s(rest);
        simd.partial_store_f32s(rest, function(simd, value));
    }
}

/// The class of each row of `log_probs + noise` [rows, classes]: the first of the largest.
///
/// # Panics
/// If the lengths do not fit: a programming error.
pub fn draw(log_probs: &[f32], noise: &[f32], classes: usize, z: &mut [i64]) {
    assert_eq!(log_probs.len(), noise.len(), "draw: as much noise as log-probabilities");
    assert_eq!(log_probs.len(), z.len() * classes, "draw: one class a row");
    let rows = log_probs.chunks_exact(classes).zip(noise.chunks_exact(classes));
    for ((log_probs, noise), z) in rows.zip(z) {
        let (mut best, mut class) = (f32::NEG_INFINITY, 0);
        for (index, (log_prob, noise)) in log_probs.iter().zip(noise).enumerate() {
            let score = log_prob + noise;
            if score > best {
                (best, class) = (score, index);
            }
        }
        *z = class as i64;
    }
}

/// `KL[q || p]` in nats, summed over all categoricals, from log-probabilities of the same length.
#[must_use]
pub fn divergence(arch: Arch, q: &[f32], p: &[f32]) -> f32 {
    arch.dispatch(Divergence { q, p })
}

struct Divergence<'a> {
    q: &'a [f32],
    p: &'a [f32],
}

impl WithSimd for Divergence<'_> {
    type Output = f32;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f32 {
        let ((q, q_rest), (p, p_rest)) = (S::as_simd_f32s(self.q), S::as_simd_f32s(self.p));
        let mut sums = [simd.splat_f32s(0.0); 2];
        for (index, (q, p)) in q.iter().zip(p).enumerate() {
            let sum = &mut sums[index % 2];
            *sum = simd.mul_add_f32s(exp(simd, *q), simd.sub_f32s(*q, *p), *sum);
        }
        let rest: f32 = q_rest.iter().zip(p_rest).map(|(q, p)| q.exp() * (q - p)).sum();
        simd.reduce_sum_f32s(simd.add_f32s(sums[0], sums[1])) + rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(len: usize, scale: f32) -> Vec<f32> {
        (0..len).map(|i| (i as f32 * 0.73).sin() * scale).collect()
    }

    fn exact(logits: &[f32], classes: usize) -> Vec<f32> {
        let row = |row: &[f32]| {
            let largest = row.iter().copied().fold(f32::MIN, f32::max);
            let sum: f32 = row.iter().map(|x| (x - largest).exp()).sum();
            row.iter()
                .map(|x| (0.99 * (x - largest).exp() / sum + 0.01 / row.len() as f32).ln())
                .collect::<Vec<_>>()
        };
        logits.chunks_exact(classes).flat_map(row).collect()
    }

    #[test]
    fn log_probabilities_are_those_of_the_formula_for_any_number_of_classes() {
        for classes in [4, 8, 16, 20, 32] {
            let logits = numbers(6 * classes, 9.0);
            let expected = exact(&logits, classes);
            for arch in [Arch::new(), Arch::Scalar] {
                let mut found = logits.clone();
                log_probs(arch, &mut found, classes, 0.99, 0.01 / classes as f32);
                for (found, expected) in found.iter().zip(&expected) {
                    assert!((found - expected).abs() < 5e-6, "{classes}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn a_logit_that_is_no_number_poisons_its_row() {
        let mut logits = numbers(32, 1.0);
        logits[5] = f32::NAN;
        log_probs(Arch::new(), &mut logits, 16, 0.99, 0.000_625);
        assert!(logits[..16].iter().all(|x| x.is_nan()) && logits[16..].iter().all(|x| x.is_finite()));
    }

    #[test]
    fn the_class_is_the_first_of_the_largest() {
        let mut z = [9; 2];
        draw(&[0.0, 2.0, 2.0, 1.0, -1.0, -1.0], &[0.0, 0.0, 0.0, 0.0, 0.0, 2.5], 3, &mut z);
        assert_eq!(z, [1, 2]);
    }

    #[test]
    fn the_divergence_is_zero_of_itself_and_the_sum_otherwise() {
        let (q, p) = (exact(&numbers(96, 3.0), 32), exact(&numbers(96, -2.0), 32));
        assert_eq!(divergence(Arch::new(), &q, &q), 0.0);
        let expected: f32 = q.iter().zip(&p).map(|(q, p)| q.exp() * (q - p)).sum();
        assert!((divergence(Arch::new(), &q, &p) - expected).abs() < 1e-4);
        assert!((divergence(Arch::Scalar, &q, &p) - expected).abs() < 1e-4);
    }
}
