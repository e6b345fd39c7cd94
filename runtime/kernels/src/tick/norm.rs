//! LayerNorm over rows, and `SiLU` behind it, in one pass over numbers that are still in the first cache.

use pulp::{Arch, Simd, WithSimd};

use crate::simd::sigmoid;

/// Parameters of a norm over the last dimension.
#[derive(Debug, Clone, PartialEq)]
pub struct Norm {
    /// Factor of each column.
    pub gain: Vec<f32>,
    /// What is added to each column.
    pub shift: Vec<f32>,
    /// Added to the variance.
    pub eps: f32,
    /// Whether `x * sigmoid(x)` follows.
    pub silu: bool,
}

impl Norm {
    /// Normalises each row of `x` [rows, width] in place.
    ///
    /// # Panics
    /// If `x` is not whole rows: a programming error.
    pub fn run(&self, arch: Arch, x: &mut [f32]) {
        assert_eq!(x.len() % self.gain.len(), 0, "norm: {} numbers in rows of {}", x.len(), self.gain.len());
        match (arch, self.gain.len()) {
            // Eight columns are one AVX2 vector.
            #[cfg(target_arch = "x86_64")]
            (Arch::V4(simd), 8) => Arch::V3(*simd).dispatch(Rows { norm: self, x }),
            _ => arch.dispatch(Rows { norm: self, x }),
        }
    }
}

struct Rows<'a> {
    norm: &'a Norm,
    x: &'a mut [f32],
}

impl WithSimd for Rows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let width = self.norm.gain.len();
        match width / S::F32_LANES {
            _ if !width.is_multiple_of(S::F32_LANES) => {
                self.x.chunks_exact_mut(width).for_each(|row| plain(self.norm, row))
            }
            1 => self.short::<S, 1>(simd),
            2 => self.short::<S, 2>(simd),
            4 => self.short::<S, 4>(simd),
            8 => self.short::<S, 8>(simd),
            _ => self.x.chunks_exact_mut(width).for_each(|row| long(simd, self.norm, row)),
        }
    }
}

impl Rows<'_> {
    /// Rows of N vectors that stay in registers.
    #[inline(always)]
    fn short<S: Simd, const N: usize>(self, simd: S) {
        let load = |x: &[f32]| -> [S::f32s; N] {
            let vectors = S::as_simd_f32s(x).0;
            std::array::from_fn(|i| vectors[i])
        };
        let (gain, shift) = (load(&self.norm.gain), load(&self.norm.shift));
        let share = simd.splat_f32s(1.0 / (N * S::F32_LANES) as f32);
        for row in self.x.chunks_exact_mut(N * S::F32_LANES) {
            let mut y = load(row);
            let mean = simd.mul_f32s(total(simd, &y), share);
            let mut squares = y;
            for (y, square) in y.iter_mut().zip(&mut squares) {
                *y = simd.sub_f32s(*y, mean);
                *square = simd.mul_f32s(*y, *y);
            }
            let variance = simd.mul_f32s(total(simd, &squares), share);
            let scale = scale(simd, variance, self.norm.eps);
            let out = S::as_mut_simd_f32s(row).0;
            for i in 0..N {
                let normed = simd.mul_add_f32s(simd.mul_f32s(y[i], scale), gain[i], shift[i]);
                out[i] = if self.norm.silu { simd.mul_f32s(normed, sigmoid(simd, normed)) } else { normed };
            }
        }
    }
}

/// Sum over all lanes of all vectors, in every lane.
#[inline(always)]
fn total<S: Simd>(simd: S, x: &[S::f32s]) -> S::f32s {
    let mut sums = [simd.splat_f32s(0.0); 4];
    for (index, x) in x.iter().enumerate() {
        sums[index % 4] = simd.add_f32s(sums[index % 4], *x);
    }
    let sum = simd.add_f32s(simd.add_f32s(sums[0], sums[1]), simd.add_f32s(sums[2], sums[3]));
    simd.splat_f32s(simd.reduce_sum_f32s(sum))
}

/// `1 / sqrt(variance + eps)`.
#[inline(always)]
fn scale<S: Simd>(simd: S, variance: S::f32s, eps: f32) -> S::f32s {
    let variance = simd.add_f32s(variance, simd.splat_f32s(eps));
    simd.div_f32s(simd.splat_f32s(1.0), simd.sqrt_f32s(variance))
}

/// A row of any number of whole vectors.
#[inline(always)]
fn long<S: Simd>(simd: S, norm: &Norm, row: &mut [f32]) {
    let share = simd.splat_f32s(1.0 / row.len() as f32);
    let y = S::as_mut_simd_f32s(row).0;
    let mean = simd.mul_f32s(total(simd, y), share);
    let mut squares = [simd.splat_f32s(0.0); 4];
    for (index, y) in y.iter_mut().enumerate() {
        *y = simd.sub_f32s(*y, mean);
        squares[index % 4] = simd.mul_add_f32s(*y, *y, squares[index % 4]);
    }
    let variance = simd.mul_f32s(total(simd, &squares), share);
    let scale = scale(simd, variance, norm.eps);
    let parameters = S::as_simd_f32s(&norm.gain).0.iter().zip(S::as_simd_f32s(&norm.shift).0);
    for (y, (gain, shift)) in y.iter_mut().zip(parameters) {
        let normed = simd.mul_add_f32s(simd.mul_f32s(*y, scale), *gain, *shift);
        *y = if norm.silu { simd.mul_f32s(normed, sigmoid(simd, normed)) } else { normed };
    }
}

/// A row of a width that no vector divides.
fn plain(norm: &Norm, row: &mut [f32]) {
    let len = row.len() as f32;
    let mean = row.iter().sum::<f32>() / len;
    let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / len;
    let scale = 1.0 / (variance + norm.eps).sqrt();
    for (x, (gain, shift)) in row.iter_mut().zip(norm.gain.iter().zip(&norm.shift)) {
        let normed = (*x - mean) * scale * gain + shift;
        *x = if norm.silu { normed / (1.0 + (-normed).exp()) } else { normed };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn vectors_give_what_the_formula_gives(
            width in prop::sample::select(vec![4usize, 8, 12, 16, 32, 64, 128, 256, 384, 512, 768]),
            rows in 1usize..4, silu: bool, seed in 0u32..1000,
        ) {
            let number = |i: usize| ((i as f32 + seed as f32) * 0.37).sin() * 3.0;
            let norm = Norm {
                gain: (0..width).map(|i| 1.0 + 0.1 * number(i)).collect(),
                shift: (0..width).map(|i| 0.2 * number(i + 7)).collect(),
                eps: 1e-3,
                silu,
            };
            let x: Vec<f32> = (0..rows * width).map(|i| number(3 * i)).collect();
            let mut expected = x.clone();
            expected.chunks_exact_mut(width).for_each(|row| plain(&norm, row));
            for arch in [Arch::new(), Arch::Scalar] {
                let mut found = x.clone();
                norm.run(arch, &mut found);
                for (found, expected) in found.iter().zip(&expected) {
                    prop_assert!((found - expected).abs() < 1e-5, "{} {}", found, expected);
                }
            }
        }
    }

    #[test]
    fn what_is_no_number_stays_none() {
        let norm = Norm { gain: vec![1.0; 64], shift: vec![0.0; 64], eps: 1e-3, silu: true };
        let mut x = vec![0.5; 64];
        x[3] = f32::NAN;
        norm.run(Arch::new(), &mut x);
        assert!(x.iter().all(|x| x.is_nan()));
    }
}
