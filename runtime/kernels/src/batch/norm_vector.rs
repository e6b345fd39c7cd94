//! LayerNorm over rows of whole vectors, written for vector registers.
//!
//! A row of 8 or 16 columns is one register. Loops over such short rows come out of the compiler with trips to memory that cost more than
//! the arithmetic, so this is spelled out.

use pulp::{Arch, Simd, WithSimd};

use super::norm_parameters::{Norm, NormGrads};
use crate::simd::sigmoid;

/// Sum over all lanes of all vectors, in every lane.
#[inline(always)]
fn total<S: Simd, const N: usize>(simd: S, x: &[S::f32s; N]) -> S::f32s {
    let mut sum = x[0];
    for x in &x[1..] {
        sum = simd.add_f32s(sum, *x);
    }
    simd.splat_f32s(simd.reduce_sum_f32s(sum))
}

/// `x` becomes `(x - mean) / sqrt(variance + eps)`; gives `1 / sqrt(variance + eps)`.
#[inline(always)]
fn standardise<S: Simd, const N: usize>(simd: S, x: &mut [S::f32s; N], eps: f32) -> S::f32s {
    let share = simd.splat_f32s(1.0 / (N * S::F32_LANES) as f32);
    let mean = simd.mul_f32s(total(simd, x), share);
    let mut squares = *x;
    for (x, square) in x.iter_mut().zip(&mut squares) {
        *x = simd.sub_f32s(*x, mean);
        *square = simd.mul_f32s(*x, *x);
    }
    let variance = simd.mul_add_f32s(total(simd, &squares), share, simd.splat_f32s(eps));
    let scale = simd.div_f32s(simd.splat_f32s(1.0), simd.sqrt_f32s(variance));
    for x in x.iter_mut() {
        *x = simd.mul_f32s(*x, scale);
    }
    scale
}

/// A row's vectors, or a norm's parameters.
#[inline(always)]
fn vectors<S: Simd, const N: usize>(x: &[f32]) -> &[[S::f32s; N]] {
    S::as_simd_f32s(x).0.as_chunks::<N>().0
}

struct Forward<'a, const N: usize> {
    x: &'a [f32],
    norm: Norm<'a>,
    out: &'a mut [f32],
}

impl<const N: usize> WithSimd for Forward<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (Some(gain), Some(shift)) =
            (vectors::<S, N>(self.norm.gain).first(), vectors::<S, N>(self.norm.shift).first())
        else {
            return;
        };
        let out = S::as_mut_simd_f32s(self.out).0.as_chunks_mut::<N>().0;
        for (x, out) in vectors::<S, N>(self.x).iter().zip(out) {
            let mut y = *x;
            standardise(simd, &mut y, self.norm.eps);
            for i in 0..N {
                y[i] = simd.mul_add_f32s(y[i], gain[i], shift[i]);
                if self.norm.silu {
                    y[i] = simd.mul_f32s(y[i], sigmoid(simd, y[i]));
                }
            }
            *out = y;
        }
    }
}

struct Backward<'a, const N: usize> {
    x: &'a [f32],
    norm: Norm<'a>,
    d_out: &'a [f32],
    dx: &'a mut [f32],
    sums: &'a mut NormGrads,
}

impl<const N: usize> WithSimd for Backward<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (Some(gain), Some(shift)) =
            (vectors::<S, N>(self.norm.gain).first(), vectors::<S, N>(self.norm.shift).first())
        else {
            return;
        };
        let zeros = [simd.splat_f32s(0.0); N];
        let (mut d_gain, mut d_shift) = (zeros, zeros);
        let (one, share) = (simd.splat_f32s(1.0), simd.splat_f32s(-1.0 / (N * S::F32_LANES) as f32));
        let rows = vectors::<S, N>(self.x).iter().zip(vectors::<S, N>(self.d_out));
        for ((x, d_out), dx) in rows.zip(S::as_mut_simd_f32s(self.dx).0.as_chunks_mut::<N>().0) {
            let (mut hat, mut d, mut d_hat) = (*x, *d_out, zeros);
            let scale = standardise(simd, &mut hat, self.norm.eps);
            for i in 0..N {
                if self.norm.silu {
                    let y = simd.mul_add_f32s(hat[i], gain[i], shift[i]);
                    let s = sigmoid(simd, y);
                    let slope = simd.mul_add_f32s(simd.mul_f32s(y, simd.sub_f32s(one, s)), s, s);
                    d[i] = simd.mul_f32s(d[i], slope);
                }
                d_shift[i] = simd.add_f32s(d_shift[i], d[i]);
                d_gain[i] = simd.mul_add_f32s(d[i], hat[i], d_gain[i]);
                d[i] = simd.mul_f32s(d[i], gain[i]);
                d_hat[i] = simd.mul_f32s(d[i], hat[i]);
            }
            let mean = simd.mul_f32s(total(simd, &d), share);
            let mean_hat = simd.mul_f32s(total(simd, &d_hat), share);
            for i in 0..N {
                let centred = simd.mul_add_f32s(hat[i], mean_hat, simd.add_f32s(d[i], mean));
                dx[i] = simd.mul_f32s(scale, centred);
            }
        }
        let sums = [(&mut self.sums.gain, d_gain), (&mut self.sums.shift, d_shift)];
        for (sum, terms) in sums {
            for (sum, term) in S::as_mut_simd_f32s(sum).0.iter_mut().zip(terms) {
                *sum = simd.add_f32s(*sum, term);
            }
        }
    }
}

/// The instruction set for rows of this width, and the vectors in a row; none where rows are not whole vectors or too long to stay in
/// registers.
fn plan(width: usize) -> Option<(Arch, usize)> {
    let arch = Arch::new();
    #[cfg(target_arch = "x86_64")]
    let (arch, lanes) = match arch {
        // Rows of 8 are one AVX2 vector, also where there is AVX-512.
        Arch::V4(simd) if !width.is_multiple_of(16) => (Arch::V3(*simd), 8),
        Arch::V4(_) => (arch, 16),
        Arch::V3(_) => (arch, 8),
        _ => return None,
    };
    #[cfg(not(target_arch = "x86_64"))]
    let lanes: usize = return None;
    (width.is_multiple_of(lanes) && matches!(width / lanes, 1 | 2 | 4 | 8)).then_some((arch, width / lanes))
}

/// As [`norm::forward`](super::norm::forward), where [`plan`] has a way; else false.
pub fn forward(x: &[f32], norm: Norm<'_>, out: &mut [f32]) -> bool {
    match plan(norm.gain.len()) {
        Some((arch, 1)) => arch.dispatch(Forward::<1> { x, norm, out }),
        Some((arch, 2)) => arch.dispatch(Forward::<2> { x, norm, out }),
        Some((arch, 4)) => arch.dispatch(Forward::<4> { x, norm, out }),
        Some((arch, 8)) => arch.dispatch(Forward::<8> { x, norm, out }),
        _ => return false,
    }
    true
}

/// As [`norm::backward`](super::norm::backward), where [`plan`] has a way; else false.
pub fn backward(x: &[f32], norm: Norm<'_>, d_out: &[f32], dx: &mut [f32], sums: &mut NormGrads) -> bool {
    match plan(norm.gain.len()) {
        Some((arch, 1)) => arch.dispatch(Backward::<1> { x, norm, d_out, dx, sums }),
        Some((arch, 2)) => arch.dispatch(Backward::<2> { x, norm, d_out, dx, sums }),
        Some((arch, 4)) => arch.dispatch(Backward::<4> { x, norm, d_out, dx, sums }),
        Some((arch, 8)) => arch.dispatch(Backward::<8> { x, norm, d_out, dx, sums }),
        _ => return false,
    }
    true
}
