//! Matrix products of views with strides, on one thread or in fixed shares of rows.

use super::parallel;

/// A view of a matrix in a slice.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Row after row, without gaps.
    pub fn new(data: &'a [f32], rows: usize, columns: usize) -> Self {
        Self::strided(data, rows, columns, columns)
    }

    /// Rows at a distance.
    ///
    /// # Panics
    /// If the slice is too short; a programming error.
    pub fn strided(data: &'a [f32], rows: usize, columns: usize, row_stride: usize) -> Self {
        let empty = rows == 0 || columns == 0;
        let needed = if empty { 0 } else { (rows - 1) * row_stride + columns };
        assert!(needed <= data.len(), "matrix [{rows}, {columns}] by {row_stride} in {} numbers", data.len());
        Self { data, rows, columns, row_stride, column_stride: 1 }
    }

    /// The transpose, without a copy.
    #[must_use]
    pub fn t(self) -> Self {
        let Self { data, rows, columns, row_stride, column_stride } = self;
        Self { data, rows: columns, columns: rows, row_stride: column_stride, column_stride: row_stride }
    }

    /// Some of the rows.
    fn rows(self, from: usize, to: usize) -> Self {
        let skip = if self.columns == 0 || from == to { 0 } else { from * self.row_stride };
        Self { data: &self.data[skip..], rows: to - from, ..self }
    }
}

/// Flops below which a second thread costs more than it gives.
const SHARE_FLOPS_MIN: usize = 1_000_000;

/// `dst (+)= a b`, rows of `dst` at `dst_stride`. Large products are shared among the threads.
///
/// # Panics
/// If the shapes do not fit; a programming error.
pub fn product(a: Matrix<'_>, b: Matrix<'_>, dst: &mut [f32], dst_stride: usize, add: bool) {
    let flops_row = 2 * a.columns * b.columns;
    let shares = parallel::shares(a.rows, SHARE_FLOPS_MIN / flops_row.max(1) + 1);
    if shares.len() == 1 {
        return product_alone(a, b, dst, dst_stride, add);
    }
    let mut tasks = Vec::with_capacity(shares.len());
    let mut rest = dst;
    for (index, share) in shares.iter().enumerate() {
        let last = index + 1 == shares.len();
        let cut = if last { rest.len() } else { share.len() * dst_stride };
        let (part, later) = rest.split_at_mut(cut);
        rest = later;
        let a = a.rows(share.start, share.end);
        tasks.push(move || product_alone(a, b, part, dst_stride, add));
    }
    parallel::run(tasks);
}

/// [`product`] on the calling thread.
///
/// # Panics
/// If the shapes do not fit; a programming error.
pub fn product_alone(a: Matrix<'_>, b: Matrix<'_>, dst: &mut [f32], dst_stride: usize, add: bool) {
    assert_eq!(a.columns, b.rows, "product of [{}, {}] and [{}, {}]", a.rows, a.columns, b.rows, b.columns);
    if a.rows == 0 || b.columns == 0 {
        return;
    }
    assert!(
        (a.rows - 1) * dst_stride + b.columns <= dst.len() && b.columns <= dst_stride,
        "product: destination too short"
    );
    // SAFETY: the constructor of `Matrix` and the assertion above keep every (row, column) of the three matrices inside its slice; `dst`
    // is borrowed mutably and so overlaps neither factor.
    unsafe {
        gemm::gemm(
            a.rows,
            b.columns,
            a.columns,
            dst.as_mut_ptr(),
            1,
            dst_stride as isize,
            add,
            a.data.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_give_the_product_of_the_whole() {
        let (m, k, n) = (301, 70, 90);
        let a: Vec<f32> = (0..m * k).map(|i| (i % 9) as f32 - 4.0).collect();
        let b: Vec<f32> = (0..n * k).map(|i| (i % 5) as f32 - 2.0).collect();
        let (a, b) = (Matrix::new(&a, m, k), Matrix::new(&b, n, k).t());
        let (mut shared, mut alone) = (vec![1.0; m * n], vec![1.0; m * n]);
        product(a, b, &mut shared, n, true);
        product_alone(a, b, &mut alone, n, true);
        assert_eq!(shared, alone);
        assert_eq!(alone[0], 1.0 + (0..k).map(|i| a.data[i] * b.data[i]).sum::<f32>());
    }
}
