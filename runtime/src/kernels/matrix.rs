//! A vector times a matrix, and sums of rows of a table: every weight is read once, in the order it lies in memory.

use std::ops::Range;

use half::f16;
use pulp::{Arch, Simd, WithSimd};

/// Columns of a wide panel: four AVX-512 vectors, 256 bytes a row.
const WIDE: usize = 64;
/// Columns of the panels that hold what is left.
const NARROW: usize = 16;

/// How weights are kept. Arithmetic is in f32 either way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// As exported.
    #[default]
    F32,
    /// Half the bytes; rounded to 11 bits.
    F16,
}

#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// Numbers that begin at a cache line.
#[derive(Debug, Clone, PartialEq)]
pub struct Lines<T = f32> {
    lines: Vec<Line>,
    len: usize,
    kind: std::marker::PhantomData<T>,
}

impl<T: bytemuck::Pod> Lines<T> {
    /// A copy.
    #[must_use]
    pub fn new(values: &[T]) -> Self {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let mut lines = vec![Line([0; 64]); bytes.len().div_ceil(64)];
        bytemuck::cast_slice_mut::<Line, u8>(&mut lines)[..bytes.len()].copy_from_slice(bytes);
        Self { lines, len: values.len(), kind: std::marker::PhantomData }
    }

    /// The numbers.
    #[must_use]
    pub fn as_slice(&self) -> &[T] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }
}

#[derive(Debug, Clone, PartialEq)]
enum Weights {
    F32(Lines<f32>),
    F16(Lines<u16>),
}

impl Weights {
    fn new(values: &[f32], precision: Precision) -> Self {
        match precision {
            Precision::F32 => Self::F32(Lines::new(values)),
            Precision::F16 => {
                let values: Vec<u16> = values.iter().map(|x| f16::from_f32(*x).to_bits()).collect();
                Self::F16(Lines::new(&values))
            }
        }
    }
}

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

/// How a vector of weights is read.
trait Read {
    type Number: Copy;
    /// # Safety
    /// As many numbers as a vector has lanes must be readable at `from`.
    unsafe fn read<S: Simd>(simd: S, from: *const Self::Number) -> S::f32s;
}

struct Full;

impl Read for Full {
    type Number = f32;
    #[inline(always)]
    unsafe fn read<S: Simd>(_: S, from: *const f32) -> S::f32s {
        // SAFETY: the caller's; a pulp vector is plain lanes of f32, read unaligned.
        unsafe { from.cast::<S::f32s>().read_unaligned() }
    }
}

struct Half;

impl Read for Half {
    type Number = u16;
    #[inline(always)]
    unsafe fn read<S: Simd>(simd: S, from: *const u16) -> S::f32s {
        #[cfg(target_arch = "x86_64")]
        if S::F32_LANES == 16 {
            use std::arch::x86_64::{__m256i, _mm256_loadu_si256, _mm512_cvtph_ps};
            // SAFETY: the caller's for the read; pulp has vectors of 16 lanes on this architecture only where it found AVX-512.
            unsafe {
                let lanes = _mm512_cvtph_ps(_mm256_loadu_si256(from.cast::<__m256i>()));
                return std::mem::transmute_copy(&lanes);
            }
        }
        let mut lanes = [0.0; 16];
        for (index, lane) in lanes.iter_mut().enumerate().take(S::F32_LANES) {
            // SAFETY: the caller's.
            *lane = f16::from_bits(unsafe { *from.add(index) }).to_f32();
        }
        simd.partial_load_f32s(&lanes[..S::F32_LANES])
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

/// A table of rows, of which some are summed: a linear layer on one-hot vectors reads only the rows of their classes.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    rows: usize,
    columns: usize,
    values: Weights,
}

impl Table {
    /// A copy of `values`, row by row.
    ///
    /// # Panics
    /// If there are not `rows * columns` values: a programming error.
    #[must_use]
    pub fn new(values: &[f32], rows: usize, columns: usize, precision: Precision) -> Self {
        assert_eq!(values.len(), rows * columns, "table: {rows} x {columns}");
        Self { rows, columns, values: Weights::new(values, precision) }
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Numbers of a row.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Adds these columns of the rows `index` to `y`.
    ///
    /// # Panics
    /// If a row does not exist or the lengths do not fit: a programming error.
    pub fn add_rows(
        &self,
        arch: Arch,
        index: impl Iterator<Item = usize> + Clone,
        columns: Range<usize>,
        y: &mut [f32],
    ) {
        assert!(columns.len() == y.len() && columns.end <= self.columns, "table: lengths");
        let mut left = (columns, y);
        // As many sums at a time as stay in registers.
        while !left.1.is_empty() {
            let (range, y) = left;
            let width = y.len().min(WIDE);
            let (now, later) = y.split_at_mut(width);
            arch.dispatch(RowSum { table: self, index: index.clone(), first: range.start, y: now });
            left = (range.start + width..range.end, later);
        }
    }
}

struct RowSum<'a, I> {
    table: &'a Table,
    index: I,
    first: usize,
    y: &'a mut [f32],
}

impl<I: Iterator<Item = usize>> WithSimd for RowSum<'_, I> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match &self.table.values {
            Weights::F32(values) => self.sum::<S, Full>(simd, values.as_slice()),
            Weights::F16(values) => self.sum::<S, Half>(simd, values.as_slice()),
        }
    }
}

impl<I: Iterator<Item = usize>> RowSum<'_, I> {
    #[inline(always)]
    fn sum<S: Simd, R: Read>(self, simd: S, values: &[R::Number]) {
        let Self { table, index, first, y } = self;
        match (S::F32_LANES, y.len()) {
            (16, 64) => Self::vectors::<S, R, 4>(simd, table, values, index, first, y),
            (8, 64) => Self::vectors::<S, R, 8>(simd, table, values, index, first, y),
            _ => {
                for row in index {
                    assert!(row < table.rows, "table: row {row} of {}", table.rows);
                    for (column, y) in y.iter_mut().enumerate() {
                        *y += table.at(row, first + column);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn vectors<S: Simd, R: Read, const V: usize>(
        simd: S,
        table: &Table,
        values: &[R::Number],
        index: I,
        first: usize,
        y: &mut [f32],
    ) {
        assert!(values.len() == table.rows * table.columns && first + V * S::F32_LANES <= table.columns);
        let places = S::as_mut_simd_f32s(y).0;
        let mut sums = [simd.splat_f32s(0.0); V];
        sums.copy_from_slice(&places[..V]);
        for row in index {
            assert!(row < table.rows, "table: row {row} of {}", table.rows);
            for (v, sum) in sums.iter_mut().enumerate() {
                // SAFETY: the row exists, and so do V vectors from `first` on in it.
                let from = unsafe { values.as_ptr().add(row * table.columns + first + v * S::F32_LANES) };
                // SAFETY: as above.
                *sum = simd.add_f32s(*sum, unsafe { R::read(simd, from) });
            }
        }
        places[..V].copy_from_slice(&sums);
    }
}

impl Table {
    fn at(&self, row: usize, column: usize) -> f32 {
        let place = row * self.columns + column;
        match &self.values {
            Weights::F32(values) => values.as_slice()[place],
            Weights::F16(values) => f16::from_bits(values.as_slice()[place]).to_f32(),
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

        #[test]
        fn rows_of_a_table_are_summed(columns in 1usize..200, picks in prop::collection::vec(0usize..9, 0..12)) {
            let table_values = numbers(9 * columns, 0.31);
            for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::F16, 1e-2)] {
                let table = Table::new(&table_values, 9, columns, precision);
                for arch in [Arch::new(), Arch::Scalar] {
                    let mut y = vec![0.5; columns];
                    table.add_rows(arch, picks.iter().copied(), 0..columns, &mut y);
                    for (column, y) in y.iter().enumerate() {
                        let exact: f32 = picks.iter().map(|row| table_values[row * columns + column]).sum();
                        prop_assert!((y - 0.5 - exact).abs() < tolerance);
                    }
                }
            }
        }
    }
}
