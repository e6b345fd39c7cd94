//! A vector times a matrix: every weight is read once, in the order it lies in memory.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};

use super::weights::{Full, Half, Precision, Read, Weights};

/// Columns of a wide panel: four AVX-512 vectors, 256 bytes a row.
const WIDE: usize = 64;
/// Columns of the panels that hold what is left.
const NARROW: usize = 16;

/// A matrix `[rows, columns]` in panels of columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Matrix {
    rows: usize,
    columns: usize,
    panels: Weights,
}

impl Matrix {
    /// Lays out `values`, row by row.
    ///
    /// # Panics
    /// If there are not `rows * columns` values: a programming error.
    #[must_use]
    pub fn new(values: &[f32], rows: usize, columns: usize, precision: Precision) -> Self {
        assert_eq!(values.len(), rows * columns, "matrix: {rows} x {columns}");
        let mut panels = Vec::with_capacity(rows * columns.next_multiple_of(NARROW));
        for (first, width) in Self::layout(columns) {
            for row in values.chunks_exact(columns) {
                let there = &row[first..columns.min(first + width)];
                panels.extend_from_slice(there);
                panels.extend(std::iter::repeat_n(0.0, width - there.len()));
            }
        }
        Self { rows, columns, panels: Weights::new(&panels, precision) }
    }

    /// First column and width of every panel.
    fn layout(columns: usize) -> impl Iterator<Item = (usize, usize)> {
        let wide = columns / WIDE * WIDE;
        let wides = (0..wide).step_by(WIDE).map(|first| (first, WIDE));
        wides.chain((wide..columns).step_by(NARROW).map(|first| (first, NARROW)))
    }

    /// Length of the vector that goes in.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Length of the vector that comes out.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Adds the share of these columns of `x W` to `y`, which begins at the first of them. The columns must begin at a multiple of 64,
    /// and end at one or at the last.
    ///
    /// # Panics
    /// If columns or lengths do not fit: a programming error.
    pub fn add_product(&self, arch: Arch, x: &[f32], columns: Range<usize>, y: &mut [f32]) {
        assert_eq!((x.len(), y.len()), (self.rows, columns.len()), "matrix: lengths");
        assert!(columns.start.is_multiple_of(WIDE) && columns.end <= self.columns);
        assert!(columns.end.is_multiple_of(WIDE) || columns.end == self.columns);
        arch.dispatch(Product { matrix: self, x, columns, y });
    }
}

struct Product<'a> {
    matrix: &'a Matrix,
    x: &'a [f32],
    columns: Range<usize>,
    y: &'a mut [f32],
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { matrix, x, columns, y } = self;
        let panels = Matrix::layout(columns.len());
        for (first, width) in panels {
            let from = (columns.start + first) * matrix.rows;
            let range = from..from + matrix.rows * width;
            let end = y.len().min(first + width);
            let y = &mut y[first..end];
            match &matrix.panels {
                Weights::F32(panels) => sum_rows::<S, Full>(simd, x, &panels.as_slice()[range], width, y),
                Weights::F16(panels) => sum_rows::<S, Half>(simd, x, &panels.as_slice()[range], width, y),
            }
        }
    }
}

/// `y += x W` of one panel; `y` may be narrower than the panel.
#[inline(always)]
fn sum_rows<S: Simd, R: Read>(simd: S, x: &[f32], panel: &[R::Number], width: usize, y: &mut [f32]) {
    match (S::F32_LANES, width) {
        (16, WIDE) => columns::<S, R, 4>(simd, x, panel, width, y),
        (8, WIDE) => columns::<S, R, 8>(simd, x, panel, width, y),
        (8, _) => columns::<S, R, 2>(simd, x, panel, width, y),
        (4, _) => columns::<S, R, 4>(simd, x, panel, width, y),
        _ => columns::<S, R, 1>(simd, x, panel, width, y),
    }
}

/// V vectors of columns at a time, two rows at a time so that sums do not wait for one another.
#[inline(always)]
fn columns<S: Simd, R: Read, const V: usize>(
    simd: S,
    x: &[f32],
    panel: &[R::Number],
    width: usize,
    y: &mut [f32],
) {
    assert_eq!(panel.len(), x.len() * width);
    for (first, y) in (0..width).step_by(V * S::F32_LANES).zip(y.chunks_mut(V * S::F32_LANES)) {
        let mut sums = [[simd.splat_f32s(0.0); V]; 2];
        for (row, x) in x.iter().enumerate() {
            let x = simd.splat_f32s(*x);
            for (v, sum) in sums[row % 2].iter_mut().enumerate() {
                // SAFETY: row < x.len() and first + V vectors <= width (a multiple of it), of a panel of x.len() * width numbers.
                let weights =
                    unsafe { R::read(simd, panel.as_ptr().add(row * width + first + v * S::F32_LANES)) };
                *sum = simd.mul_add_f32s(x, weights, *sum);
            }
        }
        for (v, y) in y.chunks_mut(S::F32_LANES).enumerate() {
            let sum = simd.add_f32s(sums[0][v], sums[1][v]);
            let sum = simd.add_f32s(simd.partial_load_f32s(y), sum);
            simd.partial_store_f32s(y, sum);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn numbers(len: usize, step: f32) -> Vec<f32> {
        (0..len).map(|i| (i as f32 * step).sin()).collect()
    }

    proptest! {
        #[test]
        fn products_are_the_sums_they_say(rows in 1usize..70, columns in 1usize..300) {
            let (w, x) = (numbers(rows * columns, 0.13), numbers(rows, 0.7));
            let exact = |column: usize| -> f32 { (0..rows).map(|row| x[row] * w[row * columns + column]).sum() };
            for (precision, tolerance) in [(Precision::F32, 1e-4), (Precision::F16, 3e-2)] {
                let matrix = Matrix::new(&w, rows, columns, precision);
                for arch in [Arch::new(), Arch::Scalar] {
                    let mut y = vec![1.0; columns];
                    let cut = columns / 2 / WIDE * WIDE;
                    let (left, right) = y.split_at_mut(cut);
                    matrix.add_product(arch, &x, 0..cut, left);
                    matrix.add_product(arch, &x, cut..columns, right);
                    for (column, y) in y.iter().enumerate() {
                        prop_assert!((y - 1.0 - exact(column)).abs() < tolerance, "{} {}", y, exact(column));
                    }
                }
            }
        }
    }
}
