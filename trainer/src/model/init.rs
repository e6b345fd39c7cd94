//! How parameters start (as in DreamerV3), drawn from the trainer's own seeded generator.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Distribution of a parameter's first values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Hidden layers and the interaction model's: normal with `std = sqrt(2 / (in + out)) / 0.8796`, redrawn beyond 2 std. The divisor gives back the
    /// spread that the cut takes. Fans count the kernel area.
    TruncatedNormal {
        /// `in + out`.
        fans: usize,
    },
    /// Output layers: uniform within `sqrt(3 * scale * 2 / (in + out))`; a scale of 0 starts at 0.
    Uniform {
        /// `in + out`.
        fans: usize,
        /// Scale of the variance.
        scale: f64,
    },
    /// Biases, the initial state.
    Zeros,
    /// Gains of normalisations.
    Ones,
}

/// Draws the values of a parameter; `name` selects the stream of the seed's generator.
#[must_use]
pub fn draw(init: &Init, shape: &[usize], seed: u64, name: &str) -> Vec<f32> {
    let count: usize = shape.iter().product();
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    generator.set_stream(fnv1a(name.as_bytes()));
    let mut normal = || -> f64 { generator.sample(StandardNormal) };
    match *init {
        Init::TruncatedNormal { fans } => {
            let std = (2.0 / fans as f64).sqrt() / 0.8796;
            (0..count).map(|_| (std * within_two(&mut normal)) as f32).collect()
        }
        Init::Uniform { fans, scale } => {
            let limit = (3.0 * scale * 2.0 / fans as f64).sqrt();
            (0..count).map(|_| ((generator.random::<f64>() * 2.0 - 1.0) * limit) as f32).collect()
        }
        Init::Zeros => vec![0.0; count],
        Init::Ones => vec![1.0; count],
    }
}

fn within_two(normal: &mut impl FnMut() -> f64) -> f64 {
    loop {
        let value = normal();
        if value.abs() <= 2.0 {
            return value;
        }
    }
}

/// A stable 64-bit hash (Fowler-Noll-Vo, variant 1a).
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spread(values: &[f32]) -> f64 {
        (values.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
    }

    #[test]
    fn hidden_layers_have_the_spread_of_the_definition_and_a_cut() {
        let values = draw(&Init::TruncatedNormal { fans: 500 }, &[200, 300], 1, "w");
        let std = (2.0f64 / 500.0).sqrt();
        assert!((spread(&values) / std - 1.0).abs() < 0.02, "{}", spread(&values) / std);
        let largest = values.iter().fold(0f32, |largest, x| largest.max(x.abs()));
        assert!(f64::from(largest) <= 2.0 * std / 0.8796 + 1e-9);
    }

    #[test]
    fn streams_differ_by_name_and_repeat_by_seed() {
        let init = Init::Uniform { fans: 8, scale: 1.0 };
        assert_eq!(draw(&init, &[4], 3, "a"), draw(&init, &[4], 3, "a"));
        assert_ne!(draw(&init, &[4], 3, "a"), draw(&init, &[4], 3, "b"));
        assert_ne!(draw(&init, &[4], 3, "a"), draw(&init, &[4], 4, "a"));
        assert_eq!(draw(&Init::Uniform { fans: 8, scale: 0.0 }, &[2], 3, "a"), [0.0, 0.0]);
    }
}
