//! One head of attention on many small matrices: queries [n, m], keys and values [r, m] per row of the batch.

use pulp::Arch;

use super::categorical::{self, Output};
use super::math::sum_of_pairs;
use super::tile::{Job, PANEL};
use crate::vectorised;

/// Sizes of one row of the batch.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// n: rows that ask.
    pub queries: usize,
    /// r: rows that answer.
    pub keys: usize,
    /// m: width of both.
    pub width: usize,
}

impl Sizes {
    fn scale(self) -> f32 {
        1.0 / (self.width as f32).sqrt()
    }
}

/// `dst [rows, columns] = a w`, entry (row, step) of `a` at `row * a_row + step * a_step`; `w` [steps, columns] must have room for reading
/// one vector beyond.
#[derive(Debug, Clone, Copy)]
struct Small {
    rows: usize,
    steps: usize,
    columns: usize,
}

impl Small {
    fn product(self, arch: Arch, a: &[f32], a_row: usize, a_step: usize, w: &[f32], dst: &mut [f32]) {
        for first in (0..self.columns).step_by(PANEL) {
            let job = Job {
                a,
                a_place: a_row,
                a_run: 0,
                a_step,
                w: &w[first..],
                w_run: 0,
                w_step: self.columns,
                runs: 1,
                steps: self.steps,
                places: self.rows,
                lanes: (self.columns - first).min(PANEL),
                dst_stride: self.columns,
                add: false,
            };
            job.run(arch, &mut dst[first..]);
        }
    }
}

fn transpose(x: &[f32], rows: usize, columns: usize, out: &mut [f32]) {
    for row in 0..rows {
        for column in 0..columns {
            out[column * rows + row] = x[row * columns + column];
        }
    }
}

/// A copy with room for reading one vector beyond.
fn with_room(x: &[f32], buffer: &mut [f32]) {
    buffer[..x.len()].copy_from_slice(x);
}

/// `attention` [B, n, r] and `mixture` [B, n, m]. `4 n r m` flops a row, and a softmax of n r.
pub fn forward(sizes: Sizes, q: &[f32], k: &[f32], v: &[f32], attention: &mut [f32], mixture: &mut [f32]) {
    let Sizes { queries: n, keys: r, width: m } = sizes;
    let arch = Arch::new();
    let mut turned = vec![0.0; r * m + PANEL];
    let mut scores = vec![0.0; n * r];
    let rows = q.chunks_exact(n * m).zip(k.chunks_exact(r * m)).zip(v.chunks_exact(r * m));
    for (((q, k), v), (attention, mixture)) in
        rows.zip(attention.chunks_exact_mut(n * r).zip(mixture.chunks_exact_mut(n * m)))
    {
        transpose(k, r, m, &mut turned);
        Small { rows: n, steps: m, columns: r }.product(arch, q, m, 1, &turned, &mut scores);
        scores.iter_mut().for_each(|score| *score *= sizes.scale());
        categorical::distribution(&scores, r, 0.0, Output::Probabilities, attention);
        with_room(v, &mut turned);
        Small { rows: n, steps: r, columns: m }.product(arch, attention, r, 1, &turned, mixture);
    }
}

/// Gradients of queries, keys and values from that of the mixture. `10 n r m` flops a row.
pub fn backward(
    sizes: Sizes,
    inputs: [&[f32]; 3],
    attention: &[f32],
    d_mixture: &[f32],
    d_attention: Option<&[f32]>,
    grads: [&mut [f32]; 3],
) {
    let Sizes { queries: n, keys: r, width: m } = sizes;
    let arch = Arch::new();
    let [q, k, v] = inputs;
    let [dq, dk, dv] = grads;
    let mut room = vec![0.0; n.max(r) * m + PANEL];
    let mut d_scores = vec![0.0; n * r];
    for row in 0..attention.len() / (n * r) {
        let at = |x: usize| row * x * m..(row + 1) * x * m;
        let attention = &attention[row * n * r..][..n * r];
        let d_mixture = &d_mixture[at(n)];
        with_room(d_mixture, &mut room);
        Small { rows: r, steps: n, columns: m }.product(arch, attention, 1, r, &room, &mut dv[at(r)]);
        transpose(&v[at(r)], r, m, &mut room);
        Small { rows: n, steps: m, columns: r }.product(arch, d_mixture, m, 1, &room, &mut d_scores);
        if let Some(d_attention) = d_attention {
            let more = &d_attention[row * n * r..][..n * r];
            d_scores.iter_mut().zip(more).for_each(|(sum, term)| *sum += term);
        }
        softmax_backward(attention, r, sizes.scale(), &mut d_scores);
        with_room(&k[at(r)], &mut room);
        Small { rows: n, steps: r, columns: m }.product(arch, &d_scores, r, 1, &room, &mut dq[at(n)]);
        with_room(&q[at(n)], &mut room);
        Small { rows: r, steps: n, columns: m }.product(arch, &d_scores, 1, r, &room, &mut dk[at(r)]);
    }
}

/// From the gradient of the softmax to that of the scores before their scale, in place.
fn softmax_backward(softmax: &[f32], width: usize, scale: f32, g: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            for (s, g) in softmax.chunks_exact(width).zip(g.chunks_exact_mut(width)) {
                let mean = sum_of_pairs(
                    s,
                    g,
                    #[inline(always)]
                    |s, g| s * g,
                );
                for (g, s) in g.iter_mut().zip(s) {
                    *g = scale * s * (*g - mean);
                }
            }
        },
    );
}
