//! Softmaxes with a share of the uniform distribution: samples, divergences, entropies, and the mean and likelihood of two-hot bins.
//!
//! Everything that is a function of the probabilities `p = (1 - u) softmax(logits) + u / m` has the same way back to the logits:
//! `(1 - u) s (g - sum(s g))` with `s` the softmax and `g` the gradient of `p`.

use super::math::{exp, largest, ln, sum_of, sum_of_pairs};
use crate::vectorised;

/// `softmax(logits)` of one row; gives the largest logit and the sum of exponentials above it.
#[inline(always)]
fn softmax_row(logits: &[f32], out: &mut [f32]) -> (f32, f32) {
    let top = largest(logits);
    for (out, logit) in out.iter_mut().zip(logits) {
        *out = exp(logit - top);
    }
    let sum = sum_of(
        out,
        #[inline(always)]
        |x| x,
    );
    let scale = 1.0 / sum;
    for out in out.iter_mut() {
        *out *= scale;
    }
    (top, sum)
}

/// Gradient of the logits from that of the probabilities, which stands in `g` and is replaced.
#[inline(always)]
fn softmax_row_backward(softmax: &[f32], unimix: f32, g: &mut [f32]) {
    let mean = sum_of_pairs(
        softmax,
        g,
        #[inline(always)]
        |s, g| s * g,
    );
    for (g, s) in g.iter_mut().zip(softmax) {
        *g = (1.0 - unimix) * s * (*g - mean);
    }
}

/// Mixes in the uniform distribution.
#[derive(Debug, Clone, Copy)]
struct Mix {
    keep: f32,
    add: f32,
}

impl Mix {
    #[inline(always)]
    fn new(unimix: f32, classes: usize) -> Self {
        Self { keep: 1.0 - unimix, add: unimix / classes as f32 }
    }

    #[inline(always)]
    fn of(self, s: f32) -> f32 {
        self.keep * s + self.add
    }
}

/// What is made of the probabilities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Output {
    Probabilities,
    /// Their logarithms.
    Logarithms,
}

/// `out` = probabilities or their logarithms, [rows, classes]. About 25 flops (45 with logarithm) and 8 bytes a number.
pub fn distribution(logits: &[f32], classes: usize, unimix: f32, output: Output, out: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let mix = Mix::new(unimix, classes);
            for (logits, out) in logits.chunks_exact(classes).zip(out.chunks_exact_mut(classes)) {
                let (top, sum) = softmax_row(logits, out);
                if output == Output::Probabilities {
                    for p in out.iter_mut() {
                        *p = mix.of(*p);
                    }
                } else if unimix > 0.0 {
                    for p in out.iter_mut() {
                        *p = ln(mix.of(*p));
                    }
                } else {
                    let shift = top + ln(sum);
                    for (out, logit) in out.iter_mut().zip(logits) {
                        *out = logit - shift;
                    }
                }
            }
        },
    );
}

/// Gradient of the logits for [`distribution`].
pub fn distribution_backward(
    logits: &[f32],
    classes: usize,
    unimix: f32,
    output: Output,
    d_out: &[f32],
    d_logits: &mut [f32],
) {
    vectorised(
        #[inline(always)]
        || {
            let mix = Mix::new(unimix, classes);
            let mut softmax = vec![0.0; classes];
            let rows = logits.chunks_exact(classes).zip(d_out.chunks_exact(classes));
            for ((logits, d_out), g) in rows.zip(d_logits.chunks_exact_mut(classes)) {
                softmax_row(logits, &mut softmax);
                if output == Output::Logarithms && unimix == 0.0 {
                    let sum = sum_of(
                        d_out,
                        #[inline(always)]
                        |g| g,
                    );
                    for ((g, d), s) in g.iter_mut().zip(d_out).zip(&softmax) {
                        *g = d - s * sum;
                    }
                    continue;
                }
                g.copy_from_slice(d_out);
                if output == Output::Logarithms {
                    for (g, s) in g.iter_mut().zip(&softmax) {
                        *g /= mix.of(*s);
                    }
                }
                softmax_row_backward(&softmax, unimix, g);
            }
        },
    );
}

/// One-hot of `argmax(ln p + gumbel)`, or of the most probable class; the first of equals. [rows, classes].
pub fn sample(logits: &[f32], classes: usize, unimix: f32, gumbel: Option<&[f32]>, z: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let mix = Mix::new(unimix, classes);
            for (row, (logits, z)) in
                logits.chunks_exact(classes).zip(z.chunks_exact_mut(classes)).enumerate()
            {
                if let Some(gumbel) = gumbel {
                    softmax_row(logits, z);
                    let gumbel = &gumbel[row * classes..][..classes];
                    for (z, gumbel) in z.iter_mut().zip(gumbel) {
                        *z = ln(mix.of(*z)) + gumbel;
                    }
                } else {
                    z.copy_from_slice(logits);
                }
                let top = largest(z);
                let best = z.iter().position(|score| *score == top).unwrap_or(0);
                let nan = z.iter().any(|score| score.is_nan());
                z.fill(if nan { f32::NAN } else { 0.0 });
                z[best] = if nan { f32::NAN } else { 1.0 };
            }
        },
    );
}

/// `max(free, KL)` of each row of `categoricals`, with the gradient halves apart. Inputs [rows, categoricals * classes].
#[derive(Debug, Clone, Copy)]
pub struct Divergence {
    /// Classes of a categorical.
    pub classes: usize,
    /// Categoricals of a row.
    pub categoricals: usize,
    /// Share of the uniform distribution.
    pub unimix: f32,
}

impl Divergence {
    /// `KL[q || p]`, summed over the categoricals of each row. About 100 flops and 8 bytes a logit.
    pub fn forward(&self, q: &[f32], p: &[f32], out: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || {
                let mix = Mix::new(self.unimix, self.classes);
                let (mut sq, mut sp) = (vec![0.0; self.classes], vec![0.0; self.classes]);
                let width = self.classes * self.categoricals;
                for ((q, p), out) in q.chunks_exact(width).zip(p.chunks_exact(width)).zip(out) {
                    *out = 0.0;
                    for (q, p) in q.chunks_exact(self.classes).zip(p.chunks_exact(self.classes)) {
                        softmax_row(q, &mut sq);
                        softmax_row(p, &mut sp);
                        *out += sum_of_pairs(
                            &sq,
                            &sp,
                            #[inline(always)]
                            |q, p| {
                                let (q, p) = (mix.of(q), mix.of(p));
                                q * (ln(q) - ln(p))
                            },
                        );
                    }
                }
            },
        );
    }

    /// Gradients of the logits of q and p; a row's gradient is `scale_q[row]` and `scale_p[row]` times that of its divergence.
    pub fn backward(&self, q: &[f32], p: &[f32], scales: (&[f32], &[f32]), dq: &mut [f32], dp: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || {
                let mix = Mix::new(self.unimix, self.classes);
                let (mut sq, mut sp) = (vec![0.0; self.classes], vec![0.0; self.classes]);
                let rows = q.chunks_exact(self.classes).zip(p.chunks_exact(self.classes));
                let grads = dq.chunks_exact_mut(self.classes).zip(dp.chunks_exact_mut(self.classes));
                for (index, ((q, p), (dq, dp))) in rows.zip(grads).enumerate() {
                    let row = index / self.categoricals;
                    let (scale_q, scale_p) = (scales.0[row], scales.1[row]);
                    softmax_row(q, &mut sq);
                    softmax_row(p, &mut sp);
                    for i in 0..q.len() {
                        let (q, p) = (mix.of(sq[i]), mix.of(sp[i]));
                        dq[i] = scale_q * (ln(q) - ln(p) + 1.0);
                        dp[i] = -scale_p * q / p;
                    }
                    softmax_row_backward(&sq, self.unimix, dq);
                    softmax_row_backward(&sp, self.unimix, dp);
                }
            },
        );
    }
}

/// Entropy of each row [rows]. About 45 flops a logit.
pub fn entropy(logits: &[f32], classes: usize, unimix: f32, out: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let mix = Mix::new(unimix, classes);
            let mut softmax = vec![0.0; classes];
            for (logits, out) in logits.chunks_exact(classes).zip(out) {
                softmax_row(logits, &mut softmax);
                *out = -sum_of(
                    &softmax,
                    #[inline(always)]
                    |s| mix.of(s) * ln(mix.of(s).max(f32::MIN_POSITIVE)),
                );
            }
        },
    );
}

/// Gradient of the logits for [`entropy`].
pub fn entropy_backward(logits: &[f32], classes: usize, unimix: f32, d_out: &[f32], d_logits: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let mix = Mix::new(unimix, classes);
            let mut softmax = vec![0.0; classes];
            for ((logits, d), g) in
                logits.chunks_exact(classes).zip(d_out).zip(d_logits.chunks_exact_mut(classes))
            {
                softmax_row(logits, &mut softmax);
                for (g, s) in g.iter_mut().zip(&softmax) {
                    *g = -d * (ln(mix.of(*s).max(f32::MIN_POSITIVE)) + 1.0);
                }
                softmax_row_backward(&softmax, unimix, g);
            }
        },
    );
}

/// Mean of `softmax(logits)` over `bins`, [rows]; the bins are odd in number and symmetric around 0, and are summed in
/// pairs (see `two_hot_mean`). About 25 flops and 4 bytes a logit.
pub fn mean(logits: &[f32], bins: &[f32], out: &mut [f32]) {
    let half = bins.len() / 2;
    vectorised(
        #[inline(always)]
        || {
            let mut softmax = vec![0.0; bins.len()];
            for (logits, out) in logits.chunks_exact(bins.len()).zip(out) {
                softmax_row(logits, &mut softmax);
                let (below, above) = (&softmax[..half], &softmax[half + 1..]);
                let pairs = above.iter().zip(below.iter().rev());
                *out = pairs.zip(&bins[half + 1..]).map(|((above, below), bin)| bin * (above - below)).sum();
            }
        },
    );
}

/// Gradient of the logits for [`mean`].
pub fn mean_backward(logits: &[f32], bins: &[f32], d_out: &[f32], d_logits: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let mut softmax = vec![0.0; bins.len()];
            let rows = logits.chunks_exact(bins.len()).zip(d_logits.chunks_exact_mut(bins.len()));
            for ((logits, g), d) in rows.zip(d_out) {
                softmax_row(logits, &mut softmax);
                for (g, bin) in g.iter_mut().zip(bins) {
                    *g = d * bin;
                }
                softmax_row_backward(&softmax, 0.0, g);
            }
        },
    );
}

/// Where a value lies between two of the bins: lower index, and the share of the upper one.
#[inline(always)]
fn place(bins: &[f32], value: f32) -> (usize, f32) {
    let last = bins.len() - 1;
    let value = value.clamp(bins[0], bins[last]);
    let upper = bins.partition_point(|bin| *bin <= value).clamp(1, last);
    let (low, high) = (bins[upper - 1], bins[upper]);
    (upper - 1, (value - low) / (high - low))
}

/// `-sum(two_hot(target) * log_softmax(logits))` of each row; targets in the bins' space, [rows].
pub fn two_hot_loss(logits: &[f32], bins: &[f32], targets: &[f32], out: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let mut softmax = vec![0.0; bins.len()];
            for ((logits, target), out) in logits.chunks_exact(bins.len()).zip(targets).zip(out) {
                let (top, sum) = softmax_row(logits, &mut softmax);
                let (low, share) = place(bins, *target);
                let chosen = (1.0 - share) * (logits[low] - top) + share * (logits[low + 1] - top);
                *out = ln(sum) - chosen;
            }
        },
    );
}

/// Gradient of the logits for [`two_hot_loss`]: softmax minus the two-hot target.
pub fn two_hot_loss_backward(
    logits: &[f32],
    bins: &[f32],
    targets: &[f32],
    d_out: &[f32],
    d_logits: &mut [f32],
) {
    vectorised(
        #[inline(always)]
        || {
            let rows = logits.chunks_exact(bins.len()).zip(d_logits.chunks_exact_mut(bins.len()));
            for ((logits, g), (target, d)) in rows.zip(targets.iter().zip(d_out)) {
                softmax_row(logits, g);
                let (low, share) = place(bins, *target);
                g[low] -= 1.0 - share;
                g[low + 1] -= share;
                for g in g.iter_mut() {
                    *g *= d;
                }
            }
        },
    );
}
