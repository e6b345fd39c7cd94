//! Elementary functions without branches, so that loops over them become vector instructions.
//!
//! Every function is `#[inline(always)]`: it is compiled for the instruction set of the loop that calls it (see
//! [`vectorised`](crate::vectorised)). Range reduction by powers of two, then Taylor polynomials that are short of f32's precision by
//! less than a unit in the last place.

/// `1.5 * 2^23`: adding it rounds to an integer, which then stands in the low bits.
const ROUND: f32 = 12_582_912.0;
/// ln 2 in two parts; the first has few enough bits for its product with a small integer to be exact.
const LN_2_HIGH: f32 = 0.693_145_75;
/// The rest of ln 2.
const LN_2_LOW: f32 = 1.428_606_8e-6;

/// `(r, n << 23)` with `x = n ln 2 + r` and `|r| <= ln 2 / 2`.
#[inline(always)]
fn reduce(x: f32) -> (f32, u32) {
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-LN_2_LOW, n.mul_add(-LN_2_HIGH, x));
    (r, shifted.to_bits() << 23)
}

/// `(e^r - 1) / r` for `|r| <= ln 2 / 2`.
#[inline(always)]
fn exp_m1_quotient(r: f32) -> f32 {
    let p = r.mul_add(1.0 / 40_320.0, 1.0 / 5_040.0);
    let p = r.mul_add(p, 1.0 / 720.0);
    let p = r.mul_add(p, 1.0 / 120.0);
    let p = r.mul_add(p, 1.0 / 24.0);
    let p = r.mul_add(p, 1.0 / 6.0);
    let p = r.mul_add(p, 0.5);
    r.mul_add(p, 1.0)
}

/// `e^x`; below -87 and above 88 the value at that limit. NaN stays NaN.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let (r, power) = reduce(x.clamp(-87.0, 88.0));
    let mantissa = r.mul_add(exp_m1_quotient(r), 1.0);
    f32::from_bits(mantissa.to_bits().wrapping_add(power))
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Hyperbolic tangent, through `e^2x - 1`, which keeps small values exact.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let (r, power) = reduce((2.0 * x).clamp(-20.0, 20.0));
    let scale = f32::from_bits(1f32.to_bits().wrapping_add(power));
    let exp_m1 = scale.mul_add(r * exp_m1_quotient(r), scale - 1.0);
    exp_m1 / (exp_m1 + 2.0)
}

/// Natural logarithm of a positive normal number.
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    // 0x3f35_04f3 is sqrt(1/2): the mantissa lies between sqrt(1/2) and sqrt(2).
    let exponent = (x.to_bits().wrapping_sub(0x3f35_04f3) as i32) >> 23;
    let mantissa = f32::from_bits(x.to_bits().wrapping_sub((exponent << 23) as u32));
    let f = mantissa - 1.0;
    let s = f / (2.0 + f);
    let q = s * s;
    let series = q.mul_add(2.0 / 9.0, 2.0 / 7.0);
    let series = q.mul_add(series, 2.0 / 5.0);
    let series = q.mul_add(series, 2.0 / 3.0) * q;
    // ln(1 + f) = f - f^2/2 + s (f^2/2 + series), with the large term last.
    let half = 0.5 * f * f;
    let n = exponent as f32;
    let small = s.mul_add(half + series, n * LN_2_LOW) - half + f;
    n.mul_add(LN_2_HIGH, small)
}

/// `x sigmoid(x)`.
#[inline(always)]
pub fn silu(x: f32) -> f32 {
    x * sigmoid(x)
}

/// Derivative of [`silu`].
#[inline(always)]
pub fn silu_slope(x: f32) -> f32 {
    let s = sigmoid(x);
    (x * (1.0 - s)).mul_add(s, s)
}

/// The largest entry of a slice, negative infinity of none.
#[inline(always)]
pub fn largest(x: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let (chunks, rest) = x.as_chunks::<LANES>();
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane = lane.max(*value);
        }
    }
    rest.iter().chain(&lanes).fold(f32::NEG_INFINITY, |best, value| best.max(*value))
}

/// Partial sums are kept in this many lanes, whatever the instruction set: sums are then the same on all of them.
pub const LANES: usize = 16;

/// Sum of the lanes by halves, in a fixed order. Written out, so that it stays in registers.
#[inline(always)]
pub fn sum_lanes(v: [f32; LANES]) -> f32 {
    let [a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p] = v;
    let (a, b, c, d, e, f, g, h) = (a + i, b + j, c + k, d + l, e + m, f + n, g + o, h + p);
    let (a, b, c, d) = (a + e, b + f, c + g, d + h);
    (a + c) + (b + d)
}

/// Sum of `f` over the entries of a slice.
#[inline(always)]
pub fn sum_of(x: &[f32], f: impl Fn(f32) -> f32) -> f32 {
    let mut lanes = [0f32; LANES];
    let (chunks, rest) = x.as_chunks::<LANES>();
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane += f(*value);
        }
    }
    for (lane, value) in lanes.iter_mut().zip(rest) {
        *lane += f(*value);
    }
    sum_lanes(lanes)
}

/// Sum of `f` over the pairs of two slices of equal length.
#[inline(always)]
pub fn sum_of_pairs(x: &[f32], y: &[f32], f: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0f32; LANES];
    let (chunks, rest) = x.as_chunks::<LANES>();
    let (others, other_rest) = y.as_chunks::<LANES>();
    for (chunk, other) in chunks.iter().zip(others) {
        for lane in 0..LANES {
            lanes[lane] += f(chunk[lane], other[lane]);
        }
    }
    for (lane, (a, b)) in lanes.iter_mut().zip(rest.iter().zip(other_rest)) {
        *lane += f(*a, *b);
    }
    sum_lanes(lanes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest relative error of `ours` against f64 over a fine grid; where the true value is below `floor`, relative to that.
    fn worst(ours: fn(f32) -> f32, exact: fn(f64) -> f64, from: f32, to: f32, floor: f64) -> f64 {
        let steps = 400_000;
        let at = |step: i32| from + (to - from) * (step as f32 / steps as f32);
        let error =
            |x: f32| (f64::from(ours(x)) - exact(f64::from(x))).abs() / exact(f64::from(x)).abs().max(floor);
        (0..=steps).map(|step| error(at(step))).fold(0.0, f64::max)
    }

    #[test]
    fn functions_are_accurate_to_two_units_in_the_last_place() {
        let unit = f64::from(f32::EPSILON);
        let sigmoid_exact = |x: f64| 1.0 / (1.0 + (-x).exp());
        for (name, error) in [
            ("exp", worst(exp, f64::exp, -87.0, 88.0, 0.0)),
            ("sigmoid", worst(sigmoid, sigmoid_exact, -80.0, 80.0, 0.0)),
            ("tanh", worst(tanh, f64::tanh, -12.0, 12.0, 1e-30)),
            ("tanh near 0", worst(tanh, f64::tanh, -0.01, 0.01, 1e-30)),
            ("ln", worst(ln, f64::ln, 1e-6, 1.5, 1e-6)),
            ("ln of large", worst(ln, f64::ln, 1.5, 1e6, 0.0)),
        ] {
            assert!(error <= 2.0 * unit, "{name}: {:.2} units", error / unit);
        }
    }

    #[test]
    fn extremes_are_finite_and_nan_stays_nan() {
        for x in [f32::MIN, -1e4, 1e4, f32::MAX, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(exp(x).is_finite() && (0.0..=1.0).contains(&sigmoid(x)) && tanh(x).abs() <= 1.0);
        }
        assert!([exp, sigmoid, tanh, silu].iter().all(|f| f(f32::NAN).is_nan()));
        assert_eq!((tanh(0.0), exp(0.0), sigmoid(0.0), ln(1.0)), (0.0, 1.0, 0.5, 0.0));
    }

    #[test]
    fn sums_do_not_depend_on_the_length_being_even() {
        for count in [0, 1, 15, 16, 17, 255] {
            let x: Vec<f32> = (0..count).map(|i| i as f32).collect();
            assert_eq!(sum_of(&x, |x| x), (0..count).sum::<i32>() as f32);
            assert_eq!(sum_of_pairs(&x, &x, |x, y| x - y), 0.0);
        }
        assert_eq!(largest(&[-3.0, -1.0, -2.0]), -1.0);
    }
}
