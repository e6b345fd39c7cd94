//! What decides between the mode and a sample: Gumbel noise on the latents' log-probabilities and Gaussian noise on the action.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::wire::ActionValues;

use super::PolicyError;

/// How latents and actions are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// The most probable classes and the mean action.
    Mode,
    /// Samples, repeatable by their seed.
    Sample {
        /// Seed of the generator.
        seed: u64,
    },
}

/// The noise of the current tick and where the next comes from.
pub(super) struct NoiseSource {
    rng: Option<ChaCha8Rng>,
    /// Where the generator stood before the current tick's draw.
    drawn_from: u128,
    /// Of each branch: the prior's, then the posterior's, `[2, n, m]`.
    branches: Vec<Vec<f32>>,
}

impl NoiseSource {
    /// For so many branches, each of so many categoricals times classes.
    pub(super) fn new(sampling: Sampling, branches: usize, width: usize) -> Self {
        let rng = match sampling {
            Sampling::Mode => None,
            Sampling::Sample { seed } => Some(ChaCha8Rng::seed_from_u64(seed)),
        };
        Self { rng, drawn_from: 0, branches: vec![vec![0.0; 2 * width]; branches] }
    }

    /// Fresh Gumbel noise for a tick; nothing when the mode is wanted.
    pub(super) fn draw(&mut self) {
        if let Some(rng) = &mut self.rng {
            self.drawn_from = rng.get_word_pos();
            for value in self.branches.iter_mut().flatten() {
                *value = gumbel(rng);
            }
        }
    }

    /// Where the generator stands, or stood before the last draw.
    pub(super) fn position(&self, before_draw: bool) -> u128 {
        match &self.rng {
            None => 0,
            Some(_) if before_draw => self.drawn_from,
            Some(rng) => rng.get_word_pos(),
        }
    }

    pub(super) fn set_position(&mut self, position: u128) {
        if let Some(rng) = &mut self.rng {
            rng.set_word_pos(position);
        }
    }

    pub(super) fn set(&mut self, noise: &[&[f32]]) -> Result<(), PolicyError> {
        if !noise.iter().map(|of| of.len()).eq(self.branches.iter().map(Vec::len)) {
            let lens = |found: Vec<usize>| format!("{found:?}");
            let (found, expected) = (noise.iter().map(|of| of.len()), self.branches.iter().map(Vec::len));
            let (found, expected) = (lens(found.collect()), lens(expected.collect()));
            return Err(PolicyError::Observation(format!("noise of lengths {found}, expected {expected}")));
        }
        self.rng = None;
        for (to, from) in self.branches.iter_mut().zip(noise) {
            to.copy_from_slice(from);
        }
        Ok(())
    }

    /// Gumbel noise `[2, n, m]` of each branch.
    pub(super) fn branches(&self) -> &[Vec<f32>] {
        &self.branches
    }

    pub(super) fn action(&mut self, mean: &ActionValues, std: &ActionValues) -> ActionValues {
        match &mut self.rng {
            None => *mean,
            Some(rng) => ActionValues::from_fn(mean.len(), |i| mean[i] + std[i] * gaussian(rng)),
        }
    }
}

/// Standard Gumbel: `-ln(-ln u)` with u in (0, 1).
fn gumbel(rng: &mut ChaCha8Rng) -> f32 {
    -(-uniform(rng).ln()).ln() as f32
}

/// Standard normal (Box and Muller).
fn gaussian(rng: &mut ChaCha8Rng) -> f32 {
    let radius = (-2.0 * uniform(rng).ln()).sqrt();
    (radius * (std::f64::consts::TAU * uniform(rng)).cos()) as f32
}

/// Uniform in the open interval (0, 1): the middle of one of 2^52 equal steps.
fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    ((rng.random::<u64>() >> 12) as f64 + 0.5) / (1_u64 << 52) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(sampling: Sampling) -> NoiseSource {
        NoiseSource::new(sampling, 2, 1024)
    }

    #[test]
    fn the_mode_has_no_noise_and_acts_with_the_mean() {
        let mut noise = source(Sampling::Mode);
        noise.draw();
        assert!(noise.branches().iter().flatten().all(|x| *x == 0.0));
        assert_eq!(noise.action(&[0.5; 4].into(), &[1.0; 4].into()), [0.5; 4]);
    }

    #[test]
    fn samples_repeat_with_their_seed_and_have_the_right_moments() {
        let (mut a, mut b) = (source(Sampling::Sample { seed: 7 }), source(Sampling::Sample { seed: 7 }));
        a.draw();
        b.draw();
        assert_eq!(a.branches(), b.branches());
        assert_eq!(
            a.action(&[0.0; 4].into(), &[1.0; 4].into()),
            b.action(&[0.0; 4].into(), &[1.0; 4].into())
        );
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let count = 200_000;
        // A standard Gumbel has mean 0.5772 and variance pi^2 / 6.
        let draws: Vec<f64> = (0..count).map(|_| f64::from(gumbel(&mut rng))).collect();
        let mean = draws.iter().sum::<f64>() / f64::from(count);
        let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / f64::from(count);
        assert!((mean - 0.5772).abs() < 0.01 && (variance - 1.6449).abs() < 0.03, "{mean} {variance}");
        let square =
            (0..count).map(|_| f64::from(gaussian(&mut rng)).powi(2)).sum::<f64>() / f64::from(count);
        assert!((square - 1.0).abs() < 0.02, "{square}");
    }
}
