//! Singular values of weight matrices: which of them pass on more than one number.
//!
//! Nouns: a matrix's **effective rank** is `exp(-sum p ln p)` with `p = s / sum s` over its singular values s; 1 where there is a
//! single one, n where n are equal. Its **rank share** is that of the smaller of its sides. A **dead unit** is a row that is almost 0
//! beside the others. A matrix **of rank 1** has a second singular value below a tenth of the first: what it is given leaves it as
//! one number.
//!
//! ```text
//! interaction.deter.weight   128x128   6.11  0.0583  0.0446   3.6 of  128    3 %  <- RANK 1
//! ```

mod eigenvalues;
mod table;

pub use table::{Flag, MatrixSummary, summarise};

use candle_core::{DType, Result, Tensor};

/// A matrix whose second singular value is below this share of the first is of rank 1.
pub const RANK_ONE_SHARE: f64 = 0.1;

/// Singular values of a matrix [rows, columns], largest first: as many as the smaller side is long. Those below 1e-7 of the first are
/// rounding.
///
/// # Errors
/// Those of candle, also if it is no matrix.
pub fn singular_values(matrix: &Tensor) -> Result<Vec<f64>> {
    let (rows, columns) = matrix.dims2()?;
    let matrix = matrix.detach().to_dtype(DType::F64)?;
    let transposed = matrix.t()?;
    let gram = if rows <= columns { matrix.matmul(&transposed)? } else { transposed.matmul(&matrix)? };
    let mut gram = gram.flatten_all()?.to_vec1::<f64>()?;
    let squares = eigenvalues::eigenvalues(&mut gram, rows.min(columns));
    Ok(squares.into_iter().map(|square| square.max(0.0).sqrt()).collect())
}

/// The effective rank of a matrix with these singular values; 0 where all are 0.
#[must_use]
pub fn effective_rank(singular_values: &[f64]) -> f64 {
    let sum: f64 = singular_values.iter().sum();
    if sum == 0.0 {
        return 0.0;
    }
    let shares = singular_values.iter().map(|value| value / sum).filter(|share| *share > 0.0);
    (-shares.map(|share| share * share.ln()).sum::<f64>()).exp()
}

/// Whether singular values, largest first, are those of a matrix of rank 1. A matrix with one row or column can be no other, and is none.
#[must_use]
pub fn is_rank_one(singular_values: &[f64]) -> bool {
    matches!(singular_values, [first, second, ..] if *first > 0.0 && *second < RANK_ONE_SHARE * first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    #[test]
    fn singular_values_are_the_same_of_a_matrix_and_its_transpose() {
        // Columns at right angles, of lengths 5 and 2.
        let matrix = Tensor::new(&[[3f32, 0.0], [0.0, 2.0], [4.0, 0.0]], &Device::Cpu).unwrap();
        for matrix in [matrix.clone(), matrix.t().unwrap()] {
            let found = singular_values(&matrix).unwrap();
            assert!((found[0] - 5.0).abs() < 1e-12 && (found[1] - 2.0).abs() < 1e-12, "{found:?}");
        }
    }

    #[test]
    fn the_effective_rank_counts_equal_singular_values() {
        assert!((effective_rank(&[2.0; 7]) - 7.0).abs() < 1e-12);
        assert!((effective_rank(&[3.0, 0.0, 0.0]) - 1.0).abs() < 1e-12);
        assert_eq!(effective_rank(&[0.0, 0.0]), 0.0);
        assert!((1.05..1.15).contains(&effective_rank(&[6.11, 0.058, 0.045])));
    }

    #[test]
    fn rank_one_begins_below_a_tenth() {
        assert!(is_rank_one(&[6.11, 0.058, 0.045]));
        assert!(!is_rank_one(&[1.0, 0.1]));
        assert!(!is_rank_one(&[0.0, 0.0]), "a matrix of zeros is of rank 0");
        assert!(!is_rank_one(&[1.0]), "a single row");
    }
}
