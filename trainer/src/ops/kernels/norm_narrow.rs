//! LayerNorm over few columns: sixteen rows at a time, one row to a lane.
//!
//! With 4 to 32 columns the sums across a row would cost more than all the rest. Turned around, a block of rows needs none: every sum
//! runs over the columns, lane by lane.

use super::math::{LANES, silu, silu_slope, sum_lanes};
use super::norm::{Norm, NormGrads};
use super::vectorised;

/// A block of rows, column by column.
type Block<const W: usize> = [[f32; LANES]; W];

/// Up to [`LANES`] rows; missing ones are zero.
#[inline(always)]
fn turn<const W: usize>(rows: &[[f32; W]]) -> Block<W> {
    let mut block = [[0f32; LANES]; W];
    for (lane, row) in rows.iter().enumerate().take(LANES) {
        for column in 0..W {
            block[column][lane] = row[column];
        }
    }
    block
}

#[inline(always)]
fn turn_back<const W: usize>(block: &Block<W>, rows: &mut [[f32; W]]) {
    for (lane, row) in rows.iter_mut().enumerate().take(LANES) {
        for column in 0..W {
            row[column] = block[column][lane];
        }
    }
}

/// `x` becomes `(x - mean) / sqrt(variance + eps)`; gives `1 / sqrt(variance + eps)`.
#[inline(always)]
fn standardise<const W: usize>(x: &mut Block<W>, eps: f32) -> [f32; LANES] {
    let share = 1.0 / W as f32;
    let mut mean = [0f32; LANES];
    for column in x.iter() {
        for lane in 0..LANES {
            mean[lane] += column[lane];
        }
    }
    let mut scale = [0f32; LANES];
    for column in x.iter_mut() {
        for lane in 0..LANES {
            column[lane] -= mean[lane] * share;
            scale[lane] = column[lane].mul_add(column[lane], scale[lane]);
        }
    }
    for lane in 0..LANES {
        scale[lane] = 1.0 / (scale[lane] * share + eps).sqrt();
    }
    for column in x.iter_mut() {
        for lane in 0..LANES {
            column[lane] *= scale[lane];
        }
    }
    scale
}

#[inline(always)]
fn forward_blocks<const W: usize>(x: &[f32], norm: Norm<'_>, out: &mut [f32]) {
    let (x, out) = (x.as_chunks::<W>().0, out.as_chunks_mut::<W>().0);
    for (x, out) in x.chunks(LANES).zip(out.chunks_mut(LANES)) {
        let mut block = turn(x);
        standardise(&mut block, norm.eps);
        for (column, (gain, shift)) in block.iter_mut().zip(norm.gain.iter().zip(norm.shift)) {
            for lane in 0..LANES {
                column[lane] = column[lane].mul_add(*gain, *shift);
            }
            if norm.silu {
                for lane in 0..LANES {
                    column[lane] = silu(column[lane]);
                }
            }
        }
        turn_back(&block, out);
    }
}

#[inline(always)]
fn backward_blocks<const W: usize>(x: &[f32], norm: Norm<'_>, d_out: &[f32], dx: &mut [f32], sums: &mut NormGrads) {
    let share = 1.0 / W as f32;
    let (mut d_gain, mut d_shift) = ([[0f32; LANES]; W], [[0f32; LANES]; W]);
    let rows = x.as_chunks::<W>().0.chunks(LANES).zip(d_out.as_chunks::<W>().0.chunks(LANES));
    for ((x, d_out), dx) in rows.zip(dx.as_chunks_mut::<W>().0.chunks_mut(LANES)) {
        let (mut hat, mut d) = (turn(x), turn(d_out));
        let scale = standardise(&mut hat, norm.eps);
        let (mut sum, mut sum_hat) = ([0f32; LANES], [0f32; LANES]);
        for column in 0..W {
            let (gain, shift) = (norm.gain[column], norm.shift[column]);
            let (hat, d) = (&hat[column], &mut d[column]);
            if norm.silu {
                for lane in 0..LANES {
                    d[lane] *= silu_slope(hat[lane].mul_add(gain, shift));
                }
            }
            for lane in 0..LANES {
                d_shift[column][lane] += d[lane];
                d_gain[column][lane] = d[lane].mul_add(hat[lane], d_gain[column][lane]);
                d[lane] *= gain;
                sum[lane] += d[lane];
                sum_hat[lane] = d[lane].mul_add(hat[lane], sum_hat[lane]);
            }
        }
        for column in 0..W {
            let (hat, d) = (&hat[column], &mut d[column]);
            for lane in 0..LANES {
                d[lane] = scale[lane] * hat[lane].mul_add(-sum_hat[lane] * share, sum[lane].mul_add(-share, d[lane]));
            }
        }
        turn_back(&d, dx);
    }
    for column in 0..W {
        sums.gain[column] += sum_lanes(d_gain[column]);
        sums.shift[column] += sum_lanes(d_shift[column]);
    }
}

/// As [`norm::forward`](super::norm::forward), if the rows have one of the widths that are done here.
pub fn forward(x: &[f32], norm: Norm<'_>, out: &mut [f32]) -> bool {
    vectorised(
        #[inline(always)]
        || {
            match norm.gain.len() {
                4 => forward_blocks::<4>(x, norm, out),
                8 => forward_blocks::<8>(x, norm, out),
                16 => forward_blocks::<16>(x, norm, out),
                32 => forward_blocks::<32>(x, norm, out),
                _ => return false,
            }
            true
        },
    )
}

/// As [`norm::backward`](super::norm::backward), if the rows have one of the widths that are done here.
pub fn backward(x: &[f32], norm: Norm<'_>, d_out: &[f32], dx: &mut [f32], sums: &mut NormGrads) -> bool {
    vectorised(
        #[inline(always)]
        || {
            match norm.gain.len() {
                4 => backward_blocks::<4>(x, norm, d_out, dx, sums),
                8 => backward_blocks::<8>(x, norm, d_out, dx, sums),
                16 => backward_blocks::<16>(x, norm, d_out, dx, sums),
                32 => backward_blocks::<32>(x, norm, d_out, dx, sums),
                _ => return false,
            }
            true
        },
    )
}
