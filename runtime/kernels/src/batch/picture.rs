//! Pictures of one or two branches against the camera's, pixel by pixel.

use std::sync::OnceLock;

use super::math::sigmoid;
use crate::vectorised;

/// Channels of a decoder's raw output: three of the image and a mask logit.
pub const RAW: usize = 4;

/// `x / 255 - 0.5` of every byte.
pub fn levels() -> &'static [f32; 256] {
    static LEVELS: OnceLock<[f32; 256]> = OnceLock::new();
    LEVELS.get_or_init(|| std::array::from_fn(|level| level as f32 / 255.0 - 0.5))
}

/// One image: the raw outputs [pixels, 4] of the branches, the camera's bytes [pixels, 3], and the robot's true mask [pixels].
#[derive(Debug, Clone, Copy)]
pub struct Target<'a> {
    /// Camera image.
    pub image: &'a [u8],
    /// True mask, 0 to 1.
    pub mask: Option<&'a [f32]>,
}

/// Mask probabilities of raw outputs.
#[inline(always)]
fn masks(raw: &[f32], out: &mut [f32]) {
    for (out, raw) in out.iter_mut().zip(raw.as_chunks::<RAW>().0) {
        *out = raw[3];
    }
    for out in out {
        *out = sigmoid(*out);
    }
}

/// Bytes of a pixel as numbers; the fourth is 0.
#[inline(always)]
fn pixel(bytes: &[u8; 3]) -> [f32; RAW] {
    let levels = levels();
    [levels[usize::from(bytes[0])], levels[usize::from(bytes[1])], levels[usize::from(bytes[2])], 0.0]
}

/// The difference of the whole picture (eq. 8) and the target in three channels; the fourth is 0.
#[inline(always)]
fn error(raws: [&[f32; RAW]; 2], masks: [f32; 2], target: [f32; RAW]) -> [f32; RAW] {
    let mut error = [0f32; RAW];
    for c in 0..RAW {
        error[c] = raws[0][c].mul_add(masks[0], raws[1][c].mul_add(masks[1], -target[c]));
    }
    error[3] = 0.0;
    error
}

/// Buffers for one image.
#[derive(Debug, Clone)]
pub struct Masks([Vec<f32>; 2]);

impl Masks {
    /// For images of this many pixels.
    pub fn new(pixels: usize) -> Self {
        Self([vec![0.0; pixels], vec![0.0; pixels]])
    }

    /// The factors of both pictures; of a single one, 1 and 0.
    #[inline(always)]
    fn fill(&mut self, raws: &[&[f32]]) {
        if let [only] = raws {
            masks(only, &mut self.0[0]);
            self.0[1].fill(0.0);
        } else {
            masks(raws[0], &mut self.0[0]);
            masks(raws[1], &mut self.0[1]);
        }
    }
}

/// Sum of squared errors of the picture, and of the robot's mask. About 60 flops and 40 bytes a pixel.
pub fn loss(raws: &[&[f32]], target: Target<'_>, masks: &mut Masks) -> (f32, f32) {
    vectorised(
        #[inline(always)]
        || {
            masks.fill(raws);
            let single = raws.len() == 1;
            let pixels = raws[0].as_chunks::<RAW>().0.iter().zip(raws[raws.len() - 1].as_chunks::<RAW>().0);
            let factors = masks.0[0].iter().zip(&masks.0[1]);
            let mut sums = [0f32; RAW];
            for (((a, b), (ma, mb)), bytes) in pixels.zip(factors).zip(target.image.as_chunks::<3>().0) {
                let error = error([a, b], [if single { 1.0 } else { *ma }, *mb], pixel(bytes));
                for c in 0..RAW {
                    sums[c] = error[c].mul_add(error[c], sums[c]);
                }
            }
            let mask = target.mask.map_or(0.0, |mask| {
                super::math::sum_of_pairs(
                    &masks.0[0],
                    mask,
                    #[inline(always)]
                    |a, b| (a - b) * (a - b),
                )
            });
            ((sums[0] + sums[1]) + sums[2], mask)
        },
    )
}

/// Gradients of the raw outputs, from those of the two sums.
pub fn loss_backward(
    raws: &[&[f32]],
    target: Target<'_>,
    masks: &mut Masks,
    scales: (f32, f32),
    grads: &mut [&mut [f32]],
) {
    vectorised(
        #[inline(always)]
        || {
            masks.fill(raws);
            let single = raws.len() == 1;
            let count = raws[0].len() / RAW;
            let images = target.image.as_chunks::<3>().0;
            let raw = |branch: usize| raws[branch.min(raws.len() - 1)].as_chunks::<RAW>().0;
            let (first, second) = (raw(0), raw(1));
            let (own, others) = grads.split_at_mut(1);
            let own = own[0].as_chunks_mut::<RAW>().0;
            let mut others = others.first_mut().map(|grads| grads.as_chunks_mut::<RAW>().0);
            for i in 0..count {
                let (ma, mb) = (masks.0[0][i], masks.0[1][i]);
                let factor = if single { 1.0 } else { ma };
                let error = error([&first[i], &second[i]], [factor, mb], pixel(&images[i]));
                let mut d = error;
                for d in &mut d {
                    *d *= 2.0 * scales.0;
                }
                let dot = |raw: &[f32; RAW]| (d[0] * raw[0] + d[1] * raw[1]) + d[2] * raw[2];
                let mut d_mask = if single { 0.0 } else { dot(&first[i]) };
                if let Some(mask) = target.mask {
                    d_mask += 2.0 * scales.1 * (ma - mask[i]);
                }
                own[i] = [d[0] * factor, d[1] * factor, d[2] * factor, d_mask * ma * (1.0 - ma)];
                if let Some(others) = &mut others {
                    others[i] = [d[0] * mb, d[1] * mb, d[2] * mb, dot(&second[i]) * mb * (1.0 - mb)];
                }
            }
        },
    );
}
