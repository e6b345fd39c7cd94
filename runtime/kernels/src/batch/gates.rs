//! The recurrent cell after its linear layer: LayerNorm over the three gates, then the update of h.

use super::math::{sigmoid, tanh};
use super::norm::{self, Norm, NormGrads};
use crate::vectorised;

#[inline(always)]
fn update_row(gates: &[f32], h: &[f32], next: &mut [f32]) {
    let d = h.len();
    let (reset, rest) = gates.split_at(d);
    let (cand, update) = rest.split_at(d);
    for i in 0..d {
        let cand = tanh(sigmoid(reset[i]) * cand[i]);
        next[i] = sigmoid(update[i] - 1.0).mul_add(cand - h[i], h[i]);
    }
}

/// `next` [rows, d] from normalised `gates` [rows, 3d] and `h` [rows, d]. About 70 flops and 20 bytes a number of h.
pub fn update(gates: &[f32], h: &[f32], d: usize, next: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            for ((gates, h), next) in
                gates.chunks_exact(3 * d).zip(h.chunks_exact(d)).zip(next.chunks_exact_mut(d))
            {
                update_row(gates, h, next);
            }
        },
    );
}

#[inline(always)]
fn update_row_backward(gates: &[f32], h: &[f32], d_next: &[f32], d_gates: &mut [f32], dh: &mut [f32]) {
    let d = h.len();
    let (reset, rest) = gates.split_at(d);
    let (cand, update) = rest.split_at(d);
    let (d_reset, rest) = d_gates.split_at_mut(d);
    let (d_cand, d_update) = rest.split_at_mut(d);
    let (cand, update, rest) = (&cand[..d], &update[..d], &d_next[..d]);
    for i in 0..d {
        let open = sigmoid(reset[i]);
        let value = tanh(open * cand[i]);
        let share = sigmoid(update[i] - 1.0);
        let d_inner = rest[i] * share * (1.0 - value * value);
        d_reset[i] = d_inner * cand[i] * open * (1.0 - open);
        d_cand[i] = d_inner * open;
        d_update[i] = rest[i] * (value - h[i]) * share * (1.0 - share);
        dh[i] = rest[i] * (1.0 - share);
    }
}

/// Gradients of gates and h from that of the new h.
pub fn update_backward(
    gates: &[f32],
    h: &[f32],
    d: usize,
    d_next: &[f32],
    d_gates: &mut [f32],
    dh: &mut [f32],
) {
    vectorised(
        #[inline(always)]
        || {
            let rows = gates.chunks_exact(3 * d).zip(h.chunks_exact(d)).zip(d_next.chunks_exact(d));
            for (((gates, h), d_next), (d_gates, dh)) in
                rows.zip(d_gates.chunks_exact_mut(3 * d).zip(dh.chunks_exact_mut(d)))
            {
                update_row_backward(gates, h, d_next, d_gates, dh);
            }
        },
    );
}

/// `next` [rows, d] from the linear layer's output `pre` [rows, 3d] and `h` [rows, d].
pub fn cell(pre: &[f32], norm: Norm<'_>, h: &[f32], next: &mut [f32]) {
    let d = norm.gain.len() / 3;
    let mut gates = vec![0.0; 3 * d];
    for ((pre, h), next) in pre.chunks_exact(3 * d).zip(h.chunks_exact(d)).zip(next.chunks_exact_mut(d)) {
        norm::forward(pre, norm, &mut gates);
        update(&gates, h, d, next);
    }
}

/// Gradients `d_pre` and `dh` from that of the new h; adds those of the norm to `sums`.
pub fn cell_backward(
    pre: &[f32],
    norm: Norm<'_>,
    h: &[f32],
    d_next: &[f32],
    d_pre: &mut [f32],
    dh: &mut [f32],
    sums: &mut NormGrads,
) {
    let d = norm.gain.len() / 3;
    let (mut gates, mut d_gates) = (vec![0.0; 3 * d], vec![0.0; 3 * d]);
    let rows = pre.chunks_exact(3 * d).zip(h.chunks_exact(d)).zip(d_next.chunks_exact(d));
    for (((pre, h), d_next), (d_pre, dh)) in
        rows.zip(d_pre.chunks_exact_mut(3 * d).zip(dh.chunks_exact_mut(d)))
    {
        norm::forward(pre, norm, &mut gates);
        update_backward(&gates, h, d, d_next, &mut d_gates, dh);
        norm::backward(pre, norm, &d_gates, d_pre, sums);
    }
}
