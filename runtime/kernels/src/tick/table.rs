//! Sums of rows of a table: a linear layer on one-hot vectors reads only the rows of their classes.

use std::ops::Range;

use half::f16;
use pulp::{Arch, Simd, WithSimd};

use super::weights::{Full, Half, Precision, Read, Weights};

/// Columns that are summed at a time: as many as stay in registers.
const WIDE: usize = 64;

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
