//! What is not finite never becomes finite, whatever instructions a kernel runs with: the checks behind a tick rest on it.

use pulp::Arch;

use super::conv::Conv;
use super::latents::{divergence, log_probs};
use super::matrix::Matrix;
use super::norm::Norm;
use super::table::Table;
use super::weights::Precision;
use crate::simd::tests::{Each, Exp, Function, Ln, Sigmoid};

const BAD: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

/// Every level of instructions that this machine can run.
pub(crate) fn levels() -> Vec<(&'static str, Arch)> {
    let mut levels = vec![("scalar", Arch::Scalar), ("best", Arch::new())];
    #[cfg(target_arch = "x86_64")]
    levels.extend(pulp::x86::V3::try_new().map(|simd| ("AVX2", Arch::V3(simd))));
    levels
}

fn numbers(len: usize) -> Vec<f32> {
    (0..len).map(|i| (i as f32 * 0.73).sin()).collect()
}

/// Runs `kernel` at every level with one bad number at every place of its input, and once without.
fn each(len: usize, kernel: impl Fn(&str, Arch, Option<usize>, &[f32])) {
    for (name, arch) in levels() {
        kernel(name, arch, None, &numbers(len));
        for place in 0..len {
            for bad in BAD {
                let mut input = numbers(len);
                input[place] = bad;
                kernel(name, arch, Some(place), &input);
            }
        }
    }
}

/// With a bad number all of these are bad; without, none.
fn assert_bad(out: &[f32], place: Option<usize>, what: &str) {
    let good = out.iter().filter(|x| x.is_finite()).count();
    assert_eq!(good, if place.is_some() { 0 } else { out.len() }, "{what}, {place:?}: {out:?}");
}

#[test]
fn functions_give_nothing_finite_of_what_is_not() {
    fn check<F: Function + Copy>(function: F, what: &str) {
        for (level, arch) in levels() {
            for bad in BAD {
                let mut y = vec![0.0; 64];
                arch.dispatch(Each(&[bad; 64], &mut y, function));
                assert_bad(&y, Some(0), &format!("{what}, {level}, {bad}"));
            }
        }
    }
    check(Exp, "exp");
    check(Ln, "ln");
    check(Sigmoid, "sigmoid");
}

#[test]
fn a_bad_logit_poisons_its_row_and_no_other() {
    for classes in [3, 4, 8, 16, 20, 32] {
        each(classes, |level, arch, place, logits| {
            let mut rows = [numbers(classes), logits.to_vec()].concat();
            log_probs(arch, &mut rows, classes, 0.99, 0.01 / classes as f32);
            assert_bad(&rows[..classes], None, level);
            assert_bad(&rows[classes..], place, &format!("{level}, {classes} classes"));
        });
    }
}

#[test]
fn a_bad_log_probability_makes_the_divergence_bad() {
    for len in [5, 32, 48] {
        let sound = numbers(len);
        each(len, |level, arch, place, bad| {
            assert_bad(&[divergence(arch, bad, &sound)], place, &format!("{level}, of the posterior"));
            assert_bad(&[divergence(arch, &sound, bad)], place, &format!("{level}, of the prior"));
        });
    }
}

#[test]
fn a_bad_number_makes_its_normed_row_bad() {
    for width in [7, 8, 16, 32, 64, 128, 256] {
        for silu in [false, true] {
            let norm = Norm { gain: vec![1.0; width], shift: vec![0.1; width], eps: 1e-3, silu };
            each(width, |level, arch, place, row| {
                let mut row = row.to_vec();
                norm.run(arch, &mut row);
                assert_bad(&row, place, &format!("{level}, {width} wide, silu {silu}"));
            });
        }
    }
}

#[test]
fn a_bad_input_or_weight_makes_a_product_bad() {
    const ROWS: usize = 5;
    for columns in [4, 64, 100] {
        for precision in [Precision::F32, Precision::F16] {
            let sound = Matrix::new(&vec![0.5; ROWS * columns], ROWS, columns, precision);
            each(ROWS, |level, arch, place, x| {
                let mut y = vec![0.0; columns];
                sound.add_product(arch, x, 0..columns, &mut y);
                assert_bad(&y, place, &format!("{level}, {columns} columns"));
            });
            each(ROWS * columns, |level, arch, place, weights| {
                let mut y = vec![0.0; columns];
                let matrix = Matrix::new(weights, ROWS, columns, precision);
                matrix.add_product(arch, &[0.5; ROWS], 0..columns, &mut y);
                let column = place.map_or(0, |place| place % columns);
                assert_bad(&y[column..=column], place, &format!("{level}, a weight"));
            });
        }
    }
}

#[test]
fn a_bad_number_in_a_table_makes_its_column_bad() {
    const ROWS: usize = 3;
    for columns in [4, 64, 100] {
        for precision in [Precision::F32, Precision::F16] {
            each(ROWS * columns, |level, arch, place, values| {
                let mut y = vec![0.0; columns];
                Table::new(values, ROWS, columns, precision).add_rows(arch, 0..ROWS, 0..columns, &mut y);
                let column = place.map_or(0, |place| place % columns);
                assert_bad(&y[column..=column], place, level);
            });
        }
    }
}

#[test]
fn a_bad_pixel_makes_what_is_convolved_from_it_bad() {
    const SIDE: usize = 8;
    for (channels_in, channels_out) in [(1, 8), (3, 32), (2, 16), (2, 24)] {
        let weight = vec![0.25; channels_out * channels_in * 16];
        let conv = Conv::new(&weight, channels_in, channels_out, SIDE);
        each(conv.len_in(), |level, arch, place, image| {
            let (mut padded, mut out) = (vec![0.0; conv.len_padded()], vec![0.0; conv.len_out()]);
            conv.pad(image, &mut padded);
            conv.run(arch, &padded, 0..conv.side_out(), &mut out);
            let pixel = place.map_or(0, |place| place / channels_in);
            let first = ((pixel / SIDE / 2) * conv.side_out() + pixel % SIDE / 2) * channels_out;
            assert_bad(&out[first..][..channels_out], place, level);
        });
    }
}
