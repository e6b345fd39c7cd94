//! LayerNorm over rows, with or without `SiLU` after it.

use super::math::{silu, silu_slope};
pub use super::norm_parameters::{Norm, NormGrads, add};
use super::norm_vector;
use crate::vectorised;

/// Calls `$body` with the widest `N` of 16, 8, 4, 1 that divides `$width`: chunks of `N` then make up a row.
macro_rules! with_lanes {
    ($width:expr, $body:ident($($argument:expr),*)) => {
        match $width {
            8 => $body::<8>($($argument),*),
            width if width % 16 == 0 => $body::<16>($($argument),*),
            width if width % 8 == 0 => $body::<8>($($argument),*),
            width if width % 4 == 0 => $body::<4>($($argument),*),
            _ => $body::<1>($($argument),*),
        }
    };
}

/// Adds `terms` [width] to every row.
pub fn add_to_rows(rows: &mut [f32], terms: &[f32]) {
    #[inline(always)]
    fn body<const N: usize>(rows: &mut [f32], terms: &[f32]) {
        let terms = terms.as_chunks::<N>().0;
        for row in rows.as_chunks_mut::<N>().0.chunks_exact_mut(terms.len()) {
            for (row, term) in row.iter_mut().zip(terms) {
                for lane in 0..N {
                    row[lane] += term[lane];
                }
            }
        }
    }
    vectorised(
        #[inline(always)]
        || with_lanes!(terms.len(), body(rows, terms)),
    );
}

/// Adds every row to `sum` [width].
pub fn add_rows(sum: &mut [f32], rows: &[f32]) {
    #[inline(always)]
    fn body<const N: usize>(sum: &mut [f32], rows: &[f32]) {
        let sum = sum.as_chunks_mut::<N>().0;
        for row in rows.as_chunks::<N>().0.chunks_exact(sum.len()) {
            for (sum, row) in sum.iter_mut().zip(row) {
                for lane in 0..N {
                    sum[lane] += row[lane];
                }
            }
        }
    }
    vectorised(
        #[inline(always)]
        || with_lanes!(sum.len(), body(sum, rows)),
    );
}

/// Sum of lanes by halves, in a fixed order. Written out, so that it stays in registers.
#[inline(always)]
pub(super) fn total<const N: usize>(v: [f32; N]) -> f32 {
    match *v.as_slice() {
        [a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p] => {
            let (a, b, c, d, e, f, g, h) = (a + i, b + j, c + k, d + l, e + m, f + n, g + o, h + p);
            let (a, b, c, d) = (a + e, b + f, c + g, d + h);
            (a + c) + (b + d)
        }
        [a, b, c, d, e, f, g, h] => {
            let (a, b, c, d) = (a + e, b + f, c + g, d + h);
            (a + c) + (b + d)
        }
        [a, b, c, d] => (a + c) + (b + d),
        _ => v.iter().sum(),
    }
}

/// Mean and `1 / sqrt(variance + eps)` of a row.
#[inline(always)]
fn moments<const N: usize>(x: &[[f32; N]], eps: f32) -> (f32, f32) {
    let count = (x.len() * N) as f32;
    let mut sums = [0f32; N];
    for chunk in x {
        for lane in 0..N {
            sums[lane] += chunk[lane];
        }
    }
    let mean = total(sums) / count;
    let mut squares = [0f32; N];
    for chunk in x {
        for lane in 0..N {
            let centred = chunk[lane] - mean;
            squares[lane] = centred.mul_add(centred, squares[lane]);
        }
    }
    (mean, 1.0 / (total(squares) / count + eps).sqrt())
}

#[inline(always)]
fn forward_rows<const N: usize>(x: &[f32], norm: Norm<'_>, out: &mut [f32]) {
    let width = norm.gain.len();
    let (gain, shift) = (norm.gain.as_chunks::<N>().0, norm.shift.as_chunks::<N>().0);
    for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        let x = x.as_chunks::<N>().0;
        let (mean, scale) = moments(x, norm.eps);
        let out = out.as_chunks_mut::<N>().0;
        for (((x, out), gain), shift) in x.iter().zip(out).zip(gain).zip(shift) {
            let mut y = [0f32; N];
            for lane in 0..N {
                y[lane] = ((x[lane] - mean) * scale).mul_add(gain[lane], shift[lane]);
            }
            if norm.silu {
                for y in &mut y {
                    *y = silu(*y);
                }
            }
            *out = y;
        }
    }
}

/// `x` [rows, width] normalised into `out`. About 8 flops a number, 25 with `SiLU`; 8 bytes.
pub fn forward(x: &[f32], norm: Norm<'_>, out: &mut [f32]) {
    if norm_vector::forward(x, norm, out) {
        return;
    }
    vectorised(
        #[inline(always)]
        || with_lanes!(norm.gain.len(), forward_rows(x, norm, out)),
    );
}

#[inline(always)]
fn backward_rows<const N: usize>(
    x: &[f32],
    norm: Norm<'_>,
    d_out: &[f32],
    dx: &mut [f32],
    sums: &mut NormGrads,
) {
    let width = norm.gain.len();
    let (gain, shift) = (norm.gain.as_chunks::<N>().0, norm.shift.as_chunks::<N>().0);
    let (d_gain, d_shift) = (sums.gain.as_chunks_mut::<N>().0, sums.shift.as_chunks_mut::<N>().0);
    let rows = x.chunks_exact(width).zip(d_out.chunks_exact(width)).zip(dx.chunks_exact_mut(width));
    for ((x, d_out), dx) in rows {
        let (x, d_out, dx) = (x.as_chunks::<N>().0, d_out.as_chunks::<N>().0, dx.as_chunks_mut::<N>().0);
        let (mean, scale) = moments(x, norm.eps);
        let (mut sum, mut sum_hat) = ([0f32; N], [0f32; N]);
        for i in 0..x.len() {
            let (mut hat, mut dy) = ([0f32; N], d_out[i]);
            for lane in 0..N {
                hat[lane] = (x[i][lane] - mean) * scale;
            }
            if norm.silu {
                for lane in 0..N {
                    dy[lane] *= silu_slope(hat[lane].mul_add(gain[i][lane], shift[i][lane]));
                }
            }
            for lane in 0..N {
                d_shift[i][lane] += dy[lane];
                d_gain[i][lane] = dy[lane].mul_add(hat[lane], d_gain[i][lane]);
                let d_hat = dy[lane] * gain[i][lane];
                dx[i][lane] = d_hat;
                sum[lane] += d_hat;
                sum_hat[lane] = d_hat.mul_add(hat[lane], sum_hat[lane]);
            }
        }
        let (sum, sum_hat) = (total(sum) / width as f32, total(sum_hat) / width as f32);
        for (dx, x) in dx.iter_mut().zip(x) {
            for lane in 0..N {
                let hat = (x[lane] - mean) * scale;
                dx[lane] = scale * hat.mul_add(-sum_hat, dx[lane] - sum);
            }
        }
    }
}

/// Gradient `dx` of `x` from that of the output, `d_out`; adds those of gain and shift to `sums`. About 20 flops a number, 40 with
/// `SiLU`; 12 bytes.
pub fn backward(x: &[f32], norm: Norm<'_>, d_out: &[f32], dx: &mut [f32], sums: &mut NormGrads) {
    if norm_vector::backward(x, norm, d_out, dx, sums) {
        return;
    }
    vectorised(
        #[inline(always)]
        || with_lanes!(norm.gain.len(), backward_rows(x, norm, d_out, dx, sums)),
    );
}
