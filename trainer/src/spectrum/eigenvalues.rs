use std::cmp::Ordering;

/// QR steps an eigenvalue may take on average; two to three is usual.
const STEPS_MAX: usize = 30;

/// Eigenvalues of a symmetric matrix [n, n], largest first. Only the lower triangle is read, and it is overwritten.
///
/// Householder reflections make the matrix tridiagonal, QR steps with implicit shifts make that diagonal: 4/3 n^3 flops.
///
/// # Panics
/// If the slice has not n * n numbers; a programming error.
pub(super) fn eigenvalues(matrix: &mut [f64], n: usize) -> Vec<f64> {
    assert_eq!(matrix.len(), n * n, "eigenvalues: a matrix [{n}, {n}]");
    let (mut diagonal, mut beside) = pulp::Arch::new().dispatch(|| tridiagonal(matrix, n));
    diagonalise(&mut diagonal, &mut beside);
    diagonal.sort_by(|a, b| b.partial_cmp(a).unwrap_or(Ordering::Equal));
    diagonal
}

/// Diagonal [n] and sub-diagonal [n - 1] of the tridiagonal matrix with the same eigenvalues.
#[inline(always)]
fn tridiagonal(matrix: &mut [f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut diagonal, mut beside) = (vec![0.0; n], vec![0.0; n.saturating_sub(1)]);
    let (mut v, mut p) = (vec![0.0; n], vec![0.0; n]);
    // Row i reaches left to column i - 1 only once a reflection of the first i coordinates has put its weight there.
    for i in (1..n).rev() {
        let (leading, row) = matrix.split_at_mut(i * n);
        let (v, p) = (&mut v[..i], &mut p[..i]);
        v.copy_from_slice(&row[..i]);
        diagonal[i] = row[i];
        beside[i - 1] = v[i - 1];
        let rest = dot(&v[..i - 1], &v[..i - 1]);
        if rest == 0.0 {
            continue;
        }
        beside[i - 1] = -rest.sqrt().hypot(v[i - 1]).copysign(v[i - 1]);
        v[i - 1] -= beside[i - 1];
        // H A H = A - v w^T - w v^T with H = 1 - 2 v v^T / |v|^2.
        let scale = 2.0 / dot(v, v);
        symmetric_product(leading, n, v, p);
        let half = 0.5 * scale * scale * dot(v, p);
        p.iter_mut().zip(&*v).for_each(|(p, v)| *p = scale * *p - half * v);
        for (r, row) in leading.chunks_exact_mut(n).enumerate() {
            let (by_w, by_v) = (v[r], p[r]);
            for ((x, v), w) in row[..=r].iter_mut().zip(&*v).zip(&*p) {
                *x -= by_w * w + by_v * v;
            }
        }
    }
    if let (Some(first), Some(corner)) = (diagonal.first_mut(), matrix.first()) {
        *first = *corner;
    }
    (diagonal, beside)
}

/// `p = A v`, where the lower triangle of A stands in rows at a distance of `n`.
#[inline(always)]
fn symmetric_product(lower: &[f64], n: usize, v: &[f64], p: &mut [f64]) {
    p.fill(0.0);
    for (r, row) in lower.chunks_exact(n).enumerate() {
        let left = &row[..r];
        let by = v[r];
        for (p, x) in p.iter_mut().zip(left) {
            *p += by * x;
        }
        p[r] += dot(left, &v[..r]) + row[r] * by;
    }
}

/// The scalar product, in eight sums that a vector register holds.
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut sums = [0.0; 8];
    for (a, b) in a.iter().zip(b) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    sums.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f64>()
}

/// Turns the diagonal of a tridiagonal matrix into its eigenvalues.
fn diagonalise(diagonal: &mut [f64], beside: &mut [f64]) {
    let largest = diagonal.iter().chain(&*beside).fold(0.0, |most: f64, x| most.max(x.abs()));
    let negligible = f64::EPSILON * largest;
    let mut high = beside.len();
    for _ in 0..STEPS_MAX * diagonal.len() {
        while high > 0 && beside[high - 1].abs() <= negligible {
            high -= 1;
        }
        if high == 0 {
            return;
        }
        let low = (0..high).rev().find(|at| beside[*at].abs() <= negligible).map_or(0, |at| at + 1);
        qr_step(&mut diagonal[low..=high], &mut beside[low..high]);
    }
}

/// One QR step with Wilkinson's shift: rotations of neighbours chase the element that the first one puts beside the tridiagonal down and out.
fn qr_step(diagonal: &mut [f64], beside: &mut [f64]) {
    let last = beside.len();
    let (corner, off) = (diagonal[last], beside[last - 1]);
    let half = 0.5 * (diagonal[last - 1] - corner);
    let shift = corner - off * off / (half + half.hypot(off).copysign(half));
    let (mut x, mut z) = (diagonal[0] - shift, beside[0]);
    for k in 0..last {
        let r = x.hypot(z);
        let (c, s) = if r == 0.0 { (1.0, 0.0) } else { (x / r, z / r) };
        if k > 0 {
            beside[k - 1] = r;
        }
        let (a, b, d) = (diagonal[k], beside[k], diagonal[k + 1]);
        diagonal[k] = c * c * a + 2.0 * c * s * b + s * s * d;
        diagonal[k + 1] = s * s * a - 2.0 * c * s * b + c * c * d;
        beside[k] = c * s * (d - a) + (c * c - s * s) * b;
        if k + 1 < last {
            x = beside[k];
            z = s * beside[k + 1];
            beside[k + 1] *= c;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// `Q diag(values) Q^T`, Q a product of reflections at random.
    fn with_eigenvalues(values: &[f64]) -> Vec<f64> {
        let n = values.len();
        let mut matrix = vec![0.0; n * n];
        values.iter().enumerate().for_each(|(i, value)| matrix[i * n + i] = *value);
        let mut generator = ChaCha8Rng::seed_from_u64(5);
        for _ in 0..5 {
            let u: Vec<f64> = (0..n).map(|_| generator.random_range(-1.0..1.0)).collect();
            let scale = 2.0 / u.iter().map(|x| x * x).sum::<f64>();
            for transposed in [false, true] {
                let at = |i: usize, j: usize| if transposed { j * n + i } else { i * n + j };
                for j in 0..n {
                    let along = scale * (0..n).map(|i| u[i] * matrix[at(i, j)]).sum::<f64>();
                    (0..n).for_each(|i| matrix[at(i, j)] -= along * u[i]);
                }
            }
        }
        matrix
    }

    #[test]
    fn a_matrix_gives_the_eigenvalues_it_was_made_of() {
        let spread: Vec<f64> = (0..40).map(|i| 10f64.powf(2.0 - 0.2 * f64::from(i))).collect();
        let repeated = [vec![3.0; 7], vec![1.0; 9], vec![-2.0; 2]].concat();
        let deficient = [vec![5.0, 0.5], vec![0.0; 20]].concat();
        for expected in [spread, repeated, deficient, vec![2.0], vec![4.0, 4.0], vec![0.0; 3], Vec::new()] {
            let found = eigenvalues(&mut with_eigenvalues(&expected), expected.len());
            let scale = expected.first().copied().unwrap_or(0.0);
            for (found, expected) in found.iter().zip(&expected) {
                assert!((found - expected).abs() <= 1e-12 * scale, "{found} {expected}");
            }
        }
    }

    #[test]
    fn only_the_lower_triangle_counts() {
        let found = eigenvalues(&mut [2.0, f64::NAN, 1.0, 2.0], 2);
        assert!((found[0] - 3.0).abs() < 1e-14 && (found[1] - 1.0).abs() < 1e-14, "{found:?}");
    }
}
