//! Flops and bytes of one training update, by part, from the sizes alone.
//!
//! Counted are the products of linear layers, convolutions and attention, dense, as the definition has them: two flops a multiply-add, and every
//! factor and every result once from or to memory (f32) in every call. Norms, activations, samples and losses are a few per
//! cent beside them and are not counted; nor is it counted less where a product is skipped because a one-hot row is mostly zeros.

use std::ops::{Add, AddAssign, Mul};

use rcwm_models::settings::ModelSettings;

/// Flops and bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Work {
    /// Floating-point operations.
    pub flops: f64,
    /// Bytes read and written.
    pub bytes: f64,
}

impl Add for Work {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { flops: self.flops + other.flops, bytes: self.bytes + other.bytes }
    }
}

impl AddAssign for Work {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Mul<f64> for Work {
    type Output = Self;

    fn mul(self, times: f64) -> Self {
        Self { flops: self.flops * times, bytes: self.bytes * times }
    }
}

impl std::iter::Sum for Work {
    fn sum<I: Iterator<Item = Self>>(works: I) -> Self {
        works.fold(Self::default(), Add::add)
    }
}

/// How much is learned from at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scale {
    /// B.
    pub batch: usize,
    /// T.
    pub length: usize,
    /// L.
    pub horizon: usize,
}

/// One product of `rows` vectors with a matrix [out, input]. The gradient of either factor is a product of the same size.
fn linear(rows: usize, input: usize, out: usize) -> Work {
    let [rows, input, out] = [rows, input, out].map(|x| x as f64);
    Work { flops: 2.0 * rows * input * out, bytes: 4.0 * (rows * input + input * out + rows * out) }
}

/// A convolution of kernel 4, stride 2, between maps of `side` and `2 side`; `inner` channels on the small map, `outer` on the large one. The same
/// for the transposed one.
fn convolution(images: usize, side: usize, inner: usize, outer: usize) -> Work {
    let [images, inner, outer, pixels] = [images, inner, outer, side * side].map(|x| x as f64);
    Work {
        flops: 2.0 * images * pixels * 16.0 * inner * outer,
        bytes: 4.0 * (images * pixels * (inner + 4.0 * outer) + 16.0 * inner * outer),
    }
}

/// Two hidden layers and an output: the first layer, and what follows.
fn head(rows: usize, settings: &ModelSettings, out: usize) -> [Work; 2] {
    let units = settings.units;
    [linear(rows, settings.state_width(), units), linear(rows, units, units) + linear(rows, units, out)]
}

/// Parts of the dynamics on `rows` rows: RCWM's two branches.
struct Dynamics {
    /// From z, h and the action to the priors of both branches.
    prior: Work,
    /// Posteriors of both branches.
    posterior: Work,
}

fn dynamics(rows: usize, s: &ModelSettings) -> Dynamics {
    let (nm, n, m, d, hidden) = (s.stoch_width(), s.categoricals, s.classes, s.deter, s.hidden);
    let answers = n + s.interaction_rows();
    let cell = linear(rows, hidden + d, 3 * d);
    let latent = |input: usize| linear(rows, input, hidden) + linear(rows, hidden, nm);
    let attention = linear(rows * n, m, answers) * 2.0;
    let interaction =
        linear(rows, d, d) + linear(rows * n, m, m) * 2.0 + linear(rows * answers, m, m) * 2.0 + attention;
    let inputs = linear(rows, nm + s.action, hidden) + linear(rows, nm, hidden);
    Dynamics {
        prior: inputs + (cell + latent(d)) * 2.0 + interaction,
        posterior: latent(d + 16 * 4 * s.cnn_depth) * 2.0,
    }
}

/// The encoder's first convolution, and the others.
fn encoder(images: usize, c: usize) -> [Work; 2] {
    let own = convolution(images, 8, 4 * c, 2 * c) + convolution(images, 4, 4 * c, 4 * c);
    [convolution(images, 32, c, 3), convolution(images, 16, 2 * c, c) + own * 2.0]
}

fn decoders(images: usize, s: &ModelSettings) -> Work {
    let c = s.cnn_depth;
    let convolutions = convolution(images, 4, 8 * c, 4 * c)
        + convolution(images, 8, 4 * c, 2 * c)
        + convolution(images, 16, 2 * c, c)
        + convolution(images, 32, c, 4);
    (linear(images, s.branch_width(), 16 * 8 * c) + convolutions) * 2.0
}

/// 15 flops and 28 bytes a parameter, and 2 flops and 4 bytes for the norm.
pub fn adam(parameters: usize) -> Work {
    Work { flops: 17.0, bytes: 32.0 } * parameters as f64
}

/// The parts of an update of RCWM as the trainer names them, without the optimisers.
pub fn parts(s: &ModelSettings, scale: Scale) -> Vec<(&'static str, Work)> {
    let states = scale.batch * scale.length;
    let [first, encoder] = encoder(states, s.cnn_depth);
    let step = dynamics(scale.batch, s);
    let observe = (step.prior + step.posterior) * scale.length as f64;
    let decode = decoders(states, s);
    let heads: Work = [head(states, s, s.bins), head(states, s, 1)].concat().into_iter().sum();

    let steps = (scale.horizon - 1) as f64;
    let dreamt = dynamics(states, s).prior * steps;
    let [actor_first, actor_rest] = head(states, s, 2 * s.action).map(|work| work * steps);
    let all = states * scale.horizon;
    let judge: Work =
        [head(all, s, s.bins), head(all, s, 1), head(all, s, s.bins)].concat().into_iter().sum();
    let [critic_first, critic_rest] = head(all - states, s, s.bins);
    vec![
        ("encode", first + encoder),
        ("observe", observe),
        ("decode", decode),
        ("other losses", heads),
        // The gradient of the image is not wanted.
        ("world backward", first + (encoder + observe + decode + heads) * 2.0),
        ("imagine", dreamt + actor_first + actor_rest),
        ("judge", judge),
        // The model's weights get no gradient, nor does the actor's input.
        ("actor backward", dreamt + judge + actor_first + actor_rest * 2.0),
        ("critic", (critic_first + critic_rest) * 2.0),
        ("critic backward", critic_first + critic_rest * 2.0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use rcwm_models::settings::{ModelKind, Preset};

    const SCALE: Scale = Scale { batch: 8, length: 32, horizon: 15 };

    fn work(settings: &ModelSettings, scale: Scale, part: &str) -> Work {
        let found = parts(settings, scale).into_iter().find(|(name, _)| *name == part);
        found.map(|(_, work)| work).unwrap()
    }

    #[test]
    fn a_linear_layer_is_counted_by_hand() {
        assert_eq!(linear(3, 5, 7), Work { flops: 210.0, bytes: 4.0 * (15.0 + 35.0 + 21.0) });
    }

    #[test]
    fn a_convolution_has_sixteen_products_a_pixel_of_its_small_map() {
        let found = convolution(2, 32, 8, 3);
        assert_eq!(found.flops, 2.0 * 2.0 * 1024.0 * 16.0 * 24.0);
        assert_eq!(found.bytes, 4.0 * (2.0 * 1024.0 * 8.0 + 2.0 * 4096.0 * 3.0 + 16.0 * 24.0));
    }

    #[test]
    fn the_small_encoder_is_counted_by_hand() {
        let settings = ModelSettings::preset(Preset::Small, ModelKind::Rcwm);
        // 3 -> 8 at 32x32, 8 -> 16 at 16x16, then twice 16 -> 32 at 8x8 and 32 -> 32 at 4x4.
        let products = 1024 * 24 + 256 * 128 + 2 * (64 * 512 + 16 * 1024);
        assert_eq!(work(&settings, SCALE, "encode").flops, 2.0 * 16.0 * 256.0 * f64::from(products));
    }

    #[test]
    fn work_grows_with_the_batch_and_the_length_alike_but_for_the_weights() {
        let settings = ModelSettings::preset(Preset::Small, ModelKind::Rcwm);
        for part in ["encode", "observe", "decode", "world backward", "imagine", "judge", "critic"] {
            let one = work(&settings, SCALE, part);
            for scale in [Scale { batch: 16, ..SCALE }, Scale { length: 64, ..SCALE }] {
                let two = work(&settings, scale, part);
                assert_eq!(two.flops, 2.0 * one.flops, "{part}");
                assert!(two.bytes <= 2.0 * one.bytes && two.bytes > one.bytes, "{part}");
            }
        }
    }

    #[test]
    fn a_longer_imagination_costs_the_behaviour_alone() {
        let settings = ModelSettings::preset(Preset::Paper, ModelKind::Rcwm);
        let longer = Scale { horizon: 29, ..SCALE };
        assert_eq!(work(&settings, longer, "decode"), work(&settings, SCALE, "decode"));
        assert_eq!(work(&settings, longer, "imagine"), work(&settings, SCALE, "imagine") * 2.0);
    }
}
