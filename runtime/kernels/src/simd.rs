//! Exponential, logarithm and sigmoid of a vector of numbers, to about 2 units in the last place.

use pulp::Simd;

/// 1.5 * 2^23: added to a small number, it rounds it to an integer that stands in the low bits.
const ROUND: f32 = 12_582_912.0;
/// ln 2 in two parts, so that `n * LN_2_HIGH` is exact for the n that occur.
const LN_2_HIGH: f32 = 0.693_359_4;
const LN_2_LOW: f32 = -2.121_944_4e-4;
/// 1/7! to 1/2!, then 1, 1: Taylor's series suffices on +-ln(2)/2.
const EXP: [f32; 8] = [1.0 / 5_040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];
/// Coefficients of `2 atanh(s) / s` in s^2, highest first.
const ATANH: [f32; 6] = [2.0 / 11.0, 2.0 / 9.0, 2.0 / 7.0, 2.0 / 5.0, 2.0 / 3.0, 2.0];

/// `e^x`; a finite x is held within -87 and 88. What is not finite gives NaN.
#[inline(always)]
pub(crate) fn exp<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let splat = |value: f32| simd.splat_f32s(value);
    // 0, or NaN where x is not finite: which operand of minimum and maximum wins there differs from processor to processor.
    let poison = simd.sub_f32s(x, x);
    let x = simd.min_f32s(splat(88.0), simd.max_f32s(splat(-87.0), x));
    let shifted = simd.mul_add_f32s(x, splat(std::f32::consts::LOG2_E), splat(ROUND));
    let n = simd.sub_f32s(shifted, splat(ROUND));
    let r = simd.mul_add_f32s(n, splat(-LN_2_HIGH), x);
    let r = simd.mul_add_f32s(n, splat(-LN_2_LOW), r);
    let mut p = splat(EXP[0]);
    for term in &EXP[1..] {
        p = simd.mul_add_f32s(r, p, splat(*term));
    }
    let power = simd.wrapping_dyn_shl_u32s(simd.transmute_u32s_f32s(shifted), simd.splat_u32s(23));
    simd.add_f32s(simd.transmute_f32s_u32s(simd.add_u32s(simd.transmute_u32s_f32s(p), power)), poison)
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(crate) fn sigmoid<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let one = simd.splat_f32s(1.0);
    simd.div_f32s(one, simd.add_f32s(one, exp(simd, simd.neg_f32s(x))))
}

/// `ln x` of a positive, normal x; NaN stays NaN.
#[inline(always)]
pub(crate) fn ln<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let splat = |value: f32| simd.splat_f32s(value);
    // x = 2^n * f with f in [sqrt(1/2), sqrt(2)): the offset moves the border from 1 to sqrt(1/2).
    const OFFSET: u32 = 0x3f80_0000 - 0x3f35_04f3;
    let bits = simd.add_u32s(simd.transmute_u32s_f32s(x), simd.splat_u32s(OFFSET));
    let exponent = simd.wrapping_dyn_shr_u32s(bits, simd.splat_u32s(23));
    let fraction = simd.sub_u32s(
        simd.transmute_u32s_f32s(x),
        simd.wrapping_dyn_shl_u32s(simd.sub_u32s(exponent, simd.splat_u32s(127)), simd.splat_u32s(23)),
    );
    let f = simd.transmute_f32s_u32s(fraction);
    // The exponent as a number: placed in the low bits of 2^23, less 2^23 and its offset.
    let n = simd.transmute_f32s_u32s(simd.add_u32s(exponent, simd.splat_u32s(0x4b00_0000)));
    let n = simd.sub_f32s(n, splat(8_388_608.0 + 127.0));
    let s = simd.div_f32s(simd.sub_f32s(f, splat(1.0)), simd.add_f32s(f, splat(1.0)));
    let square = simd.mul_f32s(s, s);
    let mut p = splat(ATANH[0]);
    for term in &ATANH[1..] {
        p = simd.mul_add_f32s(square, p, splat(*term));
    }
    // x - x is 0, or NaN where x is: the bits above have lost it.
    let low = simd.mul_add_f32s(n, splat(LN_2_LOW), simd.mul_add_f32s(s, p, simd.sub_f32s(x, x)));
    simd.mul_add_f32s(n, splat(LN_2_HIGH), low)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use pulp::WithSimd;

    use crate::tick::not_finite::levels;

    /// A function of every number of the first into the second; whole registers of them.
    pub(crate) struct Each<'a, F>(pub &'a [f32], pub &'a mut [f32], pub F);

    pub(crate) trait Function {
        fn at<S: Simd>(&self, simd: S, x: S::f32s) -> S::f32s;
    }

    impl<F: Function> WithSimd for Each<'_, F> {
        type Output = ();
        fn with_simd<S: Simd>(self, simd: S) {
            let (x, _) = S::as_simd_f32s(self.0);
            let (y, _) = S::as_mut_simd_f32s(self.1);
            x.iter().zip(y).for_each(|(x, y)| *y = self.2.at(simd, *x));
        }
    }

    #[derive(Clone, Copy)]
    pub(crate) struct Exp;
    #[derive(Clone, Copy)]
    pub(crate) struct Ln;
    #[derive(Clone, Copy)]
    pub(crate) struct Sigmoid;

    impl Function for Exp {
        fn at<S: Simd>(&self, simd: S, x: S::f32s) -> S::f32s {
            exp(simd, x)
        }
    }
    impl Function for Ln {
        fn at<S: Simd>(&self, simd: S, x: S::f32s) -> S::f32s {
            ln(simd, x)
        }
    }
    impl Function for Sigmoid {
        fn at<S: Simd>(&self, simd: S, x: S::f32s) -> S::f32s {
            sigmoid(simd, x)
        }
    }

    fn worst(function: impl Function + Copy, exact: fn(f64) -> f64, from: f32, to: f32) -> f64 {
        let x: Vec<f32> = (0..1 << 16).map(|i| from + (to - from) * i as f32 / 65_535.0).collect();
        let mut worst = 0.0_f64;
        for (_, arch) in levels() {
            let mut y = vec![0.0; x.len()];
            arch.dispatch(Each(&x, &mut y, function));
            for (x, y) in x.iter().zip(&y) {
                let exact = exact(f64::from(*x));
                worst = worst.max((f64::from(*y) - exact).abs() / exact.abs().max(1e-30));
            }
        }
        worst
    }

    #[test]
    fn functions_are_exact_to_the_last_places() {
        assert!(worst(Exp, f64::exp, -80.0, 80.0) < 3e-7, "{}", worst(Exp, f64::exp, -80.0, 80.0));
        assert!(worst(Ln, f64::ln, 1e-5, 0.99) < 1e-6, "{}", worst(Ln, f64::ln, 1e-5, 0.99));
        let sigmoid = worst(Sigmoid, |x| 1.0 / (1.0 + (-x).exp()), -60.0, 60.0);
        assert!(sigmoid < 4e-7, "{sigmoid}");
    }
}
