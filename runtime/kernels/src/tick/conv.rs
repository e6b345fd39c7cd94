//! Convolution of kernel 4, stride 2 and padding 1, as in the encoder, without a copy of its windows.
//!
//! Pixels are rows of channels (channels last). A window is then four runs of `4 * channels` neighbouring numbers, which are read in
//! place, one at a time, against a panel of output channels that was laid out once; up to 16 sums stay in registers.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};

use super::weights::Lines;

/// Kernel size.
const KERNEL: usize = 4;
/// Side of the smallest image that comes out.
const SIDE_OUT_MIN: usize = 4;

/// A convolution's weights, laid out for one size of image.
#[derive(Debug, Clone, PartialEq)]
pub struct Conv {
    channels_in: usize,
    channels_out: usize,
    side: usize,
    /// Output channels of a panel: 8, 16 or 32.
    width: usize,
    /// Panel by panel: [4, 4 * `channels_in`, width].
    panels: Lines,
}

impl Conv {
    /// Whether a convolution of these sizes is computed here; `side` is that of the square image that goes in.
    #[must_use]
    pub fn fits(channels_in: usize, channels_out: usize, side: usize) -> bool {
        channels_in > 0 && channels_out > 0 && side.is_power_of_two() && side >= 2 * SIDE_OUT_MIN
    }

    /// Few pixels and many weights: narrow panels let all pixels of a column be summed at once, so that each weight is read once.
    fn panel_width(channels_out: usize, side_out: usize) -> usize {
        let widest = if side_out == SIDE_OUT_MIN { 16 } else { 32 };
        channels_out.next_power_of_two().clamp(8, widest)
    }

    /// Lays out `weight` `[channels_out, channels_in, 4, 4]`.
    ///
    /// # Panics
    /// If the sizes do not [fit](Self::fits) or `weight` has another length: a programming error.
    #[must_use]
    pub fn new(weight: &[f32], channels_in: usize, channels_out: usize, side: usize) -> Self {
        assert!(
            Self::fits(channels_in, channels_out, side),
            "conv: {channels_in} to {channels_out} channels of {side}"
        );
        assert_eq!(weight.len(), channels_out * channels_in * KERNEL * KERNEL, "conv: weights");
        let width = Self::panel_width(channels_out, side / 2);
        let at = |first: usize, row: usize, step: usize, lane: usize| {
            let (column, channel) = (step / channels_in, step % channels_in);
            if first + lane >= channels_out {
                return 0.0;
            }
            weight[(((first + lane) * channels_in + channel) * KERNEL + row) * KERNEL + column]
        };
        let mut panels = Vec::with_capacity(weight.len());
        for first in (0..channels_out).step_by(width) {
            for row in 0..KERNEL {
                for step in 0..KERNEL * channels_in {
                    panels.extend((0..width).map(|lane| at(first, row, step, lane)));
                }
            }
        }
        Self { channels_in, channels_out, side, width, panels: Lines::new(&panels) }
    }

    /// Side of the image that comes out.
    #[must_use]
    pub fn side_out(&self) -> usize {
        self.side / 2
    }

    /// Channels that come out.
    #[must_use]
    pub fn channels_out(&self) -> usize {
        self.channels_out
    }

    /// Numbers of an image that goes in.
    #[must_use]
    pub fn len_in(&self) -> usize {
        self.side * self.side * self.channels_in
    }

    /// Numbers of an image that comes out.
    #[must_use]
    pub fn len_out(&self) -> usize {
        self.side_out() * self.side_out() * self.channels_out
    }

    /// Numbers of an image that goes in, with its border of one pixel.
    #[must_use]
    pub fn len_padded(&self) -> usize {
        (self.side + 2) * self.row_padded()
    }

    /// Numbers of a row with its border.
    fn row_padded(&self) -> usize {
        (self.side + 2) * self.channels_in
    }

    /// Puts `x` [side, side, channels] into the middle of `padded`, whose border is and stays as it was (zeros).
    ///
    /// # Panics
    /// If the lengths do not fit: a programming error.
    pub fn pad(&self, x: &[f32], padded: &mut [f32]) {
        for (from, to) in self.rows_of(x, padded) {
            to.copy_from_slice(from);
        }
    }

    /// Puts bytes there, as `x / divisor + shift`.
    ///
    /// # Panics
    /// As [`Self::pad`].
    pub fn pad_bytes(&self, arch: Arch, x: &[u8], (divisor, shift): (f32, f32), padded: &mut [f32]) {
        arch.dispatch(PadBytes { conv: self, x, divisor, shift, padded });
    }

    /// Rows of `x` with their places in `padded`.
    #[inline(always)]
    fn rows_of<'a, T>(
        &self,
        x: &'a [T],
        padded: &'a mut [f32],
    ) -> impl Iterator<Item = (&'a [T], &'a mut [f32])> {
        assert_eq!((x.len(), padded.len()), (self.len_in(), self.len_padded()), "conv: lengths");
        let (row, row_padded, border) = (self.side * self.channels_in, self.row_padded(), self.channels_in);
        let places = padded[row_padded..].chunks_exact_mut(row_padded);
        x.chunks_exact(row).zip(places).map(move |(from, to)| (from, &mut to[border..][..row]))
    }

    /// Computes these rows of the image that comes out into `out` [rows, `side_out`, `channels_out`]. Rows must begin and end at
    /// multiples of four.
    ///
    /// # Panics
    /// If rows or lengths do not fit: a programming error.
    pub fn run(&self, arch: Arch, padded: &[f32], rows: Range<usize>, out: &mut [f32]) {
        assert!(rows.start.is_multiple_of(4) && rows.end.is_multiple_of(4) && rows.end <= self.side_out());
        assert_eq!(padded.len(), self.len_padded(), "conv: length of what goes in");
        assert_eq!(
            out.len(),
            rows.len() * self.side_out() * self.channels_out,
            "conv: length of what comes out"
        );
        let kernel = Kernel { conv: self, padded, rows, out };
        match (arch, self.width) {
            // Eight lanes are one AVX2 vector: AVX-512's would be half empty.
            #[cfg(target_arch = "x86_64")]
            (Arch::V4(simd), 8) => Arch::V3(*simd).dispatch(kernel),
            _ => arch.dispatch(kernel),
        }
    }
}

struct PadBytes<'a> {
    conv: &'a Conv,
    x: &'a [u8],
    divisor: f32,
    shift: f32,
    padded: &'a mut [f32],
}

impl WithSimd for PadBytes<'_> {
    type Output = ();

    /// Plain loops: compiled for the instructions at hand, they become vectors by themselves.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { conv, x, divisor, shift, padded } = self;
        for (from, to) in conv.rows_of(x, padded) {
            for (from, to) in from.iter().zip(to) {
                *to = f32::from(*from) / divisor + shift;
            }
        }
    }
}

struct Kernel<'a> {
    conv: &'a Conv,
    padded: &'a [f32],
    rows: Range<usize>,
    out: &'a mut [f32],
}

impl WithSimd for Kernel<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let narrow = self.conv.side_out() == SIDE_OUT_MIN;
        match (S::F32_LANES, self.conv.width, narrow) {
            (16, 32, _) => self.panels::<S, 1, 8, 2>(simd),
            (16, 16, false) => self.panels::<S, 2, 8, 1>(simd),
            (16, 16, true) => self.panels::<S, 4, 4, 1>(simd),
            (8, 8, false) => self.panels::<S, 1, 8, 1>(simd),
            (8, 8, true) => self.panels::<S, 2, 4, 1>(simd),
            (8 | 4, ..) => self.panels::<S, 1, 4, 2>(simd),
            _ => self.panels::<S, 1, 1, 8>(simd),
        }
    }
}

impl Kernel<'_> {
    /// All panels; of each, tiles of R x C pixels and V vectors of channels.
    #[inline(always)]
    fn panels<S: Simd, const R: usize, const C: usize, const V: usize>(self, simd: S) {
        let Self { conv, padded, rows, out } = self;
        let (side, width) = (conv.side_out(), conv.width);
        debug_assert!(
            side.is_multiple_of(C) && rows.len().is_multiple_of(R) && width.is_multiple_of(V * S::F32_LANES)
        );
        let panel_len = KERNEL * KERNEL * conv.channels_in * width;
        for (index, panel) in conv.panels.as_slice().chunks_exact(panel_len).enumerate() {
            for lane in (0..width).step_by(V * S::F32_LANES) {
                // The last panel may be wider than what is left.
                let Some(left) = conv.channels_out.checked_sub(index * width + lane).filter(|left| *left > 0)
                else {
                    break;
                };
                let lanes = left.min(V * S::F32_LANES);
                for row in (0..rows.len()).step_by(R) {
                    for column in (0..side).step_by(C) {
                        let tile = Tile { conv, padded, panel, lane, row: rows.start + row, column };
                        let sums = tile.sums::<S, R, C, V>(simd);
                        for (r, sums) in sums.iter().enumerate() {
                            for (c, sums) in sums.iter().enumerate() {
                                let pixel = (row + r) * side + column + c;
                                let place = pixel * conv.channels_out + index * width + lane;
                                store(simd, sums, &mut out[place..][..lanes]);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Writes as many lanes as there is place for.
#[inline(always)]
fn store<S: Simd, const V: usize>(simd: S, sums: &[S::f32s; V], place: &mut [f32]) {
    if place.len() == V * S::F32_LANES {
        S::as_mut_simd_f32s(place).0.copy_from_slice(sums);
        return;
    }
    for (sum, place) in sums.iter().zip(place.chunks_mut(S::F32_LANES)) {
        simd.partial_store_f32s(place, *sum);
    }
}

/// Where a tile lies.
struct Tile<'a> {
    conv: &'a Conv,
    padded: &'a [f32],
    panel: &'a [f32],
    /// First channel within the panel.
    lane: usize,
    /// First row of pixels that come out.
    row: usize,
    /// First column.
    column: usize,
}

impl Tile<'_> {
    #[inline(always)]
    fn sums<S: Simd, const R: usize, const C: usize, const V: usize>(
        &self,
        simd: S,
    ) -> [[[S::f32s; V]; C]; R] {
        let conv = self.conv;
        let (row_step, column_step) = (2 * conv.row_padded(), 2 * conv.channels_in);
        let steps = KERNEL * conv.channels_in;
        let mut sums = [[[simd.splat_f32s(0.0); V]; C]; R];
        let first = self.row * row_step + self.column * column_step;
        let last =
            first + (R - 1) * row_step + (C - 1) * column_step + (KERNEL - 1) * conv.row_padded() + steps;
        assert!(last <= self.padded.len() && self.panel.len() == KERNEL * steps * conv.width);
        assert!(self.lane + V * S::F32_LANES <= conv.width);
        for kernel_row in 0..KERNEL {
            // SAFETY: `last` is one past the largest offset that any pixel, kernel row and step reads in `padded`; the panel has
            // KERNEL * steps rows of `width` numbers, of which V vectors from `lane` on are read. A pulp vector is plain lanes of
            // f32, read unaligned.
            unsafe {
                let mut a = self.padded.as_ptr().add(first + kernel_row * conv.row_padded());
                let mut w = self.panel.as_ptr().add(kernel_row * steps * conv.width + self.lane);
                for _ in 0..steps {
                    let mut weights = [simd.splat_f32s(0.0); V];
                    for (v, weights) in weights.iter_mut().enumerate() {
                        *weights = w.add(v * S::F32_LANES).cast::<S::f32s>().read_unaligned();
                    }
                    for (r, sums) in sums.iter_mut().enumerate() {
                        for (c, sums) in sums.iter_mut().enumerate() {
                            let value = simd.splat_f32s(*a.add(r * row_step + c * column_step));
                            for (sum, weights) in sums.iter_mut().zip(weights) {
                                *sum = simd.mul_add_f32s(value, weights, *sum);
                            }
                        }
                    }
                    a = a.wrapping_add(1);
                    w = w.wrapping_add(conv.width);
                }
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(len: usize, step: f32) -> Vec<f32> {
        (0..len).map(|i| (i as f32 * step).sin()).collect()
    }

    /// The definition, with channels last.
    fn exact(x: &[f32], weight: &[f32], channels: [usize; 2], side: usize) -> Vec<f32> {
        let [cin, cout] = channels;
        let mut out = Vec::new();
        for (y, x0) in (0..side / 2).flat_map(|y| (0..side / 2).map(move |x| (y, x))) {
            for o in 0..cout {
                let mut sum = 0.0_f64;
                for (ky, kx) in (0..4).flat_map(|a| (0..4).map(move |b| (a, b))) {
                    let (py, px) = ((2 * y + ky).wrapping_sub(1), (2 * x0 + kx).wrapping_sub(1));
                    if py < side && px < side {
                        for c in 0..cin {
                            let weight = weight[((o * cin + c) * 4 + ky) * 4 + kx];
                            sum += f64::from(x[(py * side + px) * cin + c]) * f64::from(weight);
                        }
                    }
                }
                out.push(sum as f32);
            }
        }
        out
    }

    #[test]
    fn every_size_of_the_model_gives_the_definition_in_whole_and_in_pieces() {
        for (cin, cout, side) in [
            (3, 8, 64),
            (3, 32, 16),
            (8, 16, 32),
            (16, 32, 16),
            (32, 32, 8),
            (16, 64, 16),
            (5, 8, 8),
            (32, 96, 8),
        ] {
            let (x, weight) = (numbers(side * side * cin, 0.37), numbers(cout * cin * 16, 0.11));
            let expected = exact(&x, &weight, [cin, cout], side);
            let conv = Conv::new(&weight, cin, cout, side);
            for arch in [Arch::new(), Arch::Scalar] {
                let mut padded = vec![0.0; conv.len_padded()];
                conv.pad(&x, &mut padded);
                let mut out = vec![0.0; conv.len_out()];
                let piece = 4 * (side / 2) * cout;
                for (index, out) in out.chunks_exact_mut(piece).enumerate() {
                    conv.run(arch, &padded, 4 * index..4 * index + 4, out);
                }
                for (found, expected) in out.iter().zip(&expected) {
                    assert!((found - expected).abs() < 1e-4, "{cin} {cout} {side}: {found} {expected}");
                }
                let mut whole = vec![0.0; conv.len_out()];
                conv.run(arch, &padded, 0..side / 2, &mut whole);
                assert_eq!(whole, out);
            }
        }
    }

    #[test]
    fn sizes_that_do_not_fit_are_said_so() {
        assert!(Conv::fits(3, 32, 64) && Conv::fits(128, 128, 8));
        for (cin, cout, side) in [(3, 8, 48), (3, 8, 4), (0, 8, 64), (3, 0, 64)] {
            assert!(!Conv::fits(cin, cout, side), "{cin} {cout} {side}");
        }
    }
}
