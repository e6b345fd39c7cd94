//! Noise out of random words.

use super::parallel;
use rcwm_kernels::batch::math::ln;
use rcwm_kernels::vectorised;

/// Words below which a second thread costs more than it gives.
const SHARE_WORDS_MIN: usize = 32_768;

/// A number between 0 and 1, both excluded, from the upper 23 bits of a word.
#[inline(always)]
fn uniform(word: u32) -> f32 {
    ((word >> 9) as f32 + 0.5) * (1.0 / 8_388_608.0)
}

/// Standard Gumbel noise, one number a word: `-ln(-ln u)`. About 50 flops and 8 bytes a number.
#[must_use]
pub fn gumbel(words: &[u32]) -> Vec<f32> {
    let mut out = vec![0.0; words.len()];
    let shares = parallel::shares(words.len(), SHARE_WORDS_MIN);
    parallel::each(&shares, parallel::split(&mut out, &shares, 1), |share, out| {
        vectorised(
            #[inline(always)]
            || {
                for (out, word) in out.iter_mut().zip(&words[share]) {
                    *out = -ln(-ln(uniform(*word)));
                }
            },
        );
    });
    out
}

/// Standard normal noise, one number from two words (Box and Muller).
#[must_use]
pub fn normal(words: &[u32]) -> Vec<f32> {
    let pairs = words.as_chunks::<2>().0.iter();
    let number = |[radius, angle]: &[u32; 2]| {
        (-2.0 * uniform(*radius).ln()).sqrt() * (std::f32::consts::TAU * uniform(*angle)).cos()
    };
    pairs.map(number).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngCore, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn words(count: usize) -> Vec<u32> {
        let mut generator = ChaCha8Rng::seed_from_u64(3);
        (0..count).map(|_| generator.next_u32()).collect()
    }

    fn moments(x: &[f32]) -> (f64, f64) {
        let count = x.len() as f64;
        let mean = x.iter().map(|x| f64::from(*x)).sum::<f64>() / count;
        (mean, x.iter().map(|x| (f64::from(*x) - mean).powi(2)).sum::<f64>() / count)
    }

    #[test]
    fn extreme_words_give_finite_noise() {
        assert!(gumbel(&[0, u32::MAX, 511, 1 << 31]).iter().all(|x| x.is_finite()));
        assert!(normal(&[0, 0, u32::MAX, u32::MAX, 0, 1 << 31]).iter().all(|x| x.is_finite()));
    }

    #[test]
    fn mean_and_variance_are_those_of_the_distributions() {
        let (mean, variance) = moments(&gumbel(&words(400_000)));
        assert!((mean - 0.577_216).abs() < 0.01 && (variance - 1.644_934).abs() < 0.02, "{mean} {variance}");
        let (mean, variance) = moments(&normal(&words(400_000)));
        assert!(mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02, "{mean} {variance}");
    }
}
