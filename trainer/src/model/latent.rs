//! Latent states, where episodes begin in them, and the noise that draws them.

use std::ops::Range;

use candle_core::{D, Device, Result, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::ops;

/// One branch's latent state s = [z, h], with the logits its z came from.
#[derive(Debug, Clone)]
pub struct Latent {
    /// One-hot rows [..., n, m], with a gradient.
    pub z: Tensor,
    /// Deterministic state [..., d].
    pub h: Tensor,
    /// Logits of z, before the uniform share is mixed in: [..., n, m].
    pub logits: Tensor,
}

impl Latent {
    /// `[z, h]`: [..., n*m + d].
    pub fn features(&self) -> Result<Tensor> {
        Tensor::cat(&[&self.z.flatten_from(self.z.rank() - 2)?, &self.h], D::Minus1)
    }

    /// Applies the same operation to z, h and logits.
    pub fn map(&self, op: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        Ok(Self { z: op(&self.z)?, h: op(&self.h)?, logits: op(&self.logits)? })
    }

    /// Latents side by side along a new dimension.
    pub fn stack<'a>(latents: impl Iterator<Item = &'a Self>, dim: usize) -> Result<Self> {
        Self::join(latents, |tensors| Tensor::stack(tensors, dim))
    }

    fn join<'a>(
        latents: impl Iterator<Item = &'a Self>,
        join: impl Fn(&[&Tensor]) -> Result<Tensor>,
    ) -> Result<Self> {
        let latents: Vec<_> = latents.collect();
        let join = |field: fn(&Self) -> &Tensor| {
            join(&latents.iter().map(|latent| field(latent)).collect::<Vec<_>>())
        };
        Ok(Self { z: join(|l| &l.z)?, h: join(|l| &l.h)?, logits: join(|l| &l.logits)? })
    }
}

/// The latent state of a whole model: robot and environment, or the one branch of the vanilla baseline.
#[derive(Debug, Clone)]
pub struct State {
    /// The branches, the robot's first.
    pub branches: Vec<Latent>,
}

impl State {
    /// `s = [z^R, h^R, z^E, h^E]`: [..., state width].
    pub fn features(&self) -> Result<Tensor> {
        let branches = self.branches.iter().map(Latent::features).collect::<Result<Vec<_>>>()?;
        Tensor::cat(&branches, D::Minus1)
    }

    /// Applies the same operation to every tensor.
    pub fn map(&self, op: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        let branches = self.branches.iter().map(|branch| branch.map(&op)).collect::<Result<_>>()?;
        Ok(Self { branches })
    }

    /// Without gradient, which lets go of the graph.
    #[must_use]
    pub fn detached(&self) -> Self {
        let branch = |latent: &Latent| Latent {
            z: latent.z.detach(),
            h: latent.h.detach(),
            logits: latent.logits.detach(),
        };
        Self { branches: self.branches.iter().map(branch).collect() }
    }

    /// Some of the rows.
    ///
    /// # Errors
    /// Those of candle, also if there are fewer.
    pub fn rows(&self, rows: &Range<usize>) -> Result<Self> {
        self.map(|x| x.narrow(0, rows.start, rows.len()))
    }

    /// States side by side along a new dimension.
    pub fn stack(states: &[Self], dim: usize) -> Result<Self> {
        Self::join(states, |tensors| Tensor::stack(tensors, dim))
    }

    /// States one after the other along their first dimension.
    pub fn cat(states: &[Self]) -> Result<Self> {
        Self::join(states, |tensors| Tensor::cat(tensors, 0))
    }

    fn join(states: &[Self], join: impl Fn(&[&Tensor]) -> Result<Tensor>) -> Result<Self> {
        let branches = states.first().map_or(0, |state| state.branches.len());
        let join = |index: usize| Latent::join(states.iter().map(|state| &state.branches[index]), &join);
        Ok(Self { branches: (0..branches).map(join).collect::<Result<_>>()? })
    }
}

/// Which steps of a batch begin an episode. Known on the host, so that steps without a beginning cost nothing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FirstSteps {
    flags: Vec<bool>,
    length: usize,
}

/// How the carried state of one step is made.
#[derive(Debug)]
pub enum Carry {
    /// Every row goes on.
    All,
    /// Every row begins.
    None,
    /// 1 where the row begins, 0 where it goes on: [B, 1].
    Some(Tensor),
}

impl FirstSteps {
    /// `flags` by row, then step: [B, T].
    ///
    /// # Panics
    /// If `flags` is no whole number of rows of `length`; a programming error.
    #[must_use]
    pub fn new(flags: Vec<bool>, length: usize) -> Self {
        assert!(length > 0 && flags.len().is_multiple_of(length), "flags must be whole rows");
        Self { flags, length }
    }

    /// Some of the rows.
    ///
    /// # Panics
    /// If there are fewer; a programming error.
    #[must_use]
    pub fn rows(&self, rows: &Range<usize>) -> Self {
        let flags = self.flags[rows.start * self.length..rows.end * self.length].to_vec();
        Self { flags, length: self.length }
    }

    /// By row, then step: [B, T].
    #[must_use]
    pub fn flags(&self) -> &[bool] {
        &self.flags
    }

    /// B.
    #[must_use]
    pub fn batch(&self) -> usize {
        self.flags.len() / self.length
    }

    /// T.
    #[must_use]
    pub fn length(&self) -> usize {
        self.length
    }

    /// What step `t` carries over from step `t - 1`; the first step of a sequence carries nothing.
    pub fn carry(&self, t: usize, device: &Device) -> Result<Carry> {
        let column: Vec<bool> = self.flags.iter().skip(t).step_by(self.length).copied().collect();
        if t == 0 || column.iter().all(|first| *first) {
            return Ok(Carry::None);
        }
        if column.iter().all(|first| !first) {
            return Ok(Carry::All);
        }
        let column: Vec<f32> = column.into_iter().map(|first| f32::from(u8::from(first))).collect();
        let batch = column.len();
        Ok(Carry::Some(Tensor::from_vec(column, (batch, 1), device)?))
    }
}

impl Carry {
    /// `initial` where an episode begins, else `carried`; both [B, ...].
    pub fn select(&self, initial: &Tensor, carried: &Tensor) -> Result<Tensor> {
        match self {
            Self::All => Ok(carried.clone()),
            Self::None => Ok(initial.clone()),
            Self::Some(first) => {
                let first =
                    first.reshape([&first.dims()[..1], vec![1; initial.rank() - 1].as_slice()].concat())?;
                let goes_on = first.affine(-1.0, 1.0)?;
                initial.broadcast_mul(&first)? + carried.broadcast_mul(&goes_on)?
            }
        }
    }

    /// The initial state where an episode begins, else the carried one.
    pub fn select_state(&self, initial: &State, carried: &State) -> Result<State> {
        let pairs = initial.branches.iter().zip(&carried.branches);
        let branches = pairs.map(|(initial, carried)| {
            Ok(Latent {
                z: self.select(&initial.z, &carried.z)?,
                h: self.select(&initial.h, &carried.h)?,
                // The logits of the carried state are never looked at again.
                logits: carried.logits.clone(),
            })
        });
        Ok(State { branches: branches.collect::<Result<_>>()? })
    }
}

/// Where samples get their noise from. candle's own generator cannot be seeded on the CPU.
#[derive(Debug, Clone)]
pub enum Sampler {
    /// No noise: categoricals give their mode, actions their mean.
    Mode,
    /// The trainer's generator.
    Seeded(Box<Noise>),
}

/// A generator whose numbers are drawn for the rows of a batch. Whoever works on some of the rows draws what these rows would
/// get if all were drawn, so that the noise does not depend on how a batch is shared out.
#[derive(Debug, Clone)]
pub struct Noise {
    generator: ChaCha8Rng,
    /// The rows that are worked on here.
    rows: Range<usize>,
    /// All rows of the batch.
    total: usize,
}

impl Sampler {
    /// A sampler whose draws repeat with the seed.
    #[must_use]
    pub fn seeded(seed: u64) -> Self {
        Self::numbered(seed, 0)
    }

    /// The sampler of one numbered step of training: seed and number say all, so there is no state to save.
    #[must_use]
    pub fn numbered(seed: u64, number: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(number);
        Self::Seeded(Box::new(Noise { generator, rows: 0..1, total: 1 }))
    }

    /// The sampler for some of the `total` rows of a batch, whose tensors all have the rows first.
    #[must_use]
    pub fn share(&self, rows: Range<usize>, total: usize) -> Self {
        match self {
            Self::Mode => Self::Mode,
            Self::Seeded(noise) => {
                Self::Seeded(Box::new(Noise { generator: noise.generator.clone(), rows, total }))
            }
        }
    }

    /// Goes on where a share of it has got to.
    pub fn follow(&mut self, share: Self) {
        if let (Self::Seeded(noise), Self::Seeded(share)) = (self, share) {
            noise.generator = share.generator;
        }
    }

    /// Standard Gumbel noise of this shape; none for the mode.
    pub fn gumbel(&mut self, shape: &[usize], device: &Device) -> Result<Option<Tensor>> {
        self.draw(shape, device, 1, ops::gumbel)
    }

    /// Standard normal noise of this shape; none for the mean.
    pub fn normal(&mut self, shape: &[usize], device: &Device) -> Result<Option<Tensor>> {
        self.draw(shape, device, 2, ops::normal)
    }

    fn draw(
        &mut self,
        shape: &[usize],
        device: &Device,
        words_per_number: usize,
        noise: fn(&[u32]) -> Vec<f32>,
    ) -> Result<Option<Tensor>> {
        let Self::Seeded(source) = self else { return Ok(None) };
        let words = source.words(words_per_number * shape.iter().product::<usize>());
        Tensor::from_vec(noise(&words), shape, device).map(Some)
    }
}

impl Noise {
    /// This many words for the rows here; passes over those of the others.
    fn words(&mut self, count: usize) -> Vec<u32> {
        let each = (count / self.rows.len().max(1)) as u128;
        let start = self.generator.get_word_pos();
        let mut words = vec![0; count];
        self.generator.set_word_pos(start + each * self.rows.start as u128);
        self.generator.fill(words.as_mut_slice());
        self.generator.set_word_pos(start + each * self.total as u128);
        words
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_begins_only_where_it_is_marked_and_at_the_start_of_a_sequence() {
        let device = Device::Cpu;
        let first = FirstSteps::new(vec![false, false, true, true, false, false], 3);
        let initial = Tensor::zeros((2, 2), candle_core::DType::F32, &device).unwrap();
        let carried = Tensor::ones((2, 2), candle_core::DType::F32, &device).unwrap();
        let at = |t: usize| {
            first.carry(t, &device).unwrap().select(&initial, &carried).unwrap().to_vec2::<f32>().unwrap()
        };
        assert_eq!(at(0), [[0.0, 0.0], [0.0, 0.0]]);
        assert_eq!(at(1), [[1.0, 1.0], [1.0, 1.0]]);
        assert_eq!(at(2), [[0.0, 0.0], [1.0, 1.0]]);
    }

    #[test]
    fn shares_of_a_batch_draw_what_the_whole_batch_draws() {
        let device = Device::Cpu;
        let numbers = |x: Option<Tensor>| x.unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let draw = |sampler: &mut Sampler, rows: usize| {
            let gumbel = numbers(sampler.gumbel(&[rows, 3, 7], &device).unwrap());
            (gumbel, numbers(sampler.normal(&[rows, 4], &device).unwrap()))
        };
        let mut whole = Sampler::numbered(5, 2);
        let mut shares = [whole.share(0..2, 5), whole.share(2..5, 5)];
        for _ in 0..2 {
            let expected = draw(&mut whole, 5);
            let (first, second) = (draw(&mut shares[0], 2), draw(&mut shares[1], 3));
            assert_eq!(([first.0, second.0].concat(), [first.1, second.1].concat()), expected);
        }
        let [share, _] = shares;
        let mut other = Sampler::numbered(5, 2);
        other.follow(share);
        assert_eq!(draw(&mut other, 5), draw(&mut whole, 5));
    }

    #[test]
    fn gumbel_noise_draws_classes_as_often_as_they_are_probable() {
        let device = Device::Cpu;
        let logits = Tensor::new(&[0.6f32, 0.3, 0.1], &device).unwrap().log().unwrap();
        let logits = logits.broadcast_as((20_000, 3)).unwrap();
        let noise = Sampler::seeded(5).gumbel(&[20_000, 3], &device).unwrap();
        let sample = crate::ops::straight_through_sample(&logits, 0.0, noise.as_ref()).unwrap();
        let share = sample.mean(0).unwrap().to_vec1::<f32>().unwrap();
        for (found, expected) in share.iter().zip([0.6, 0.3, 0.1]) {
            assert!((found - expected).abs() < 0.02, "{share:?}");
        }
    }
}
