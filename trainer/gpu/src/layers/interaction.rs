//! What the robot does to the environment (eq. 7).

use super::{Linear, Norm};
use crate::machine::Kernel;
use crate::program::{Grid, Matrix, Pointer};
use crate::tape::Tape;

/// Robot to environment.
#[derive(Debug, Clone, Copy)]
pub struct Interaction {
    /// h to k rows.
    pub deter: Linear,
    pub(super) query: Linear,
    pub(super) key: Linear,
    pub(super) value: Linear,
    pub(super) output: Linear,
    pub(super) norm: Norm,
}

/// Rows of the interaction: inputs, output, and what the weights' gradients need.
#[derive(Debug, Clone, Copy)]
pub struct Attending {
    /// Environment's z_{t-1} [rows, n m].
    pub z: Matrix,
    /// Robot's prior z_t and k rows of its h_t [rows, (n+k) m].
    pub u: Matrix,
    /// Features e_{t-1} [rows, n m].
    pub e: Matrix,
    /// Mixtures [rows, n m], where the weights are trained.
    pub mix: Option<Matrix>,
    /// Sums before the norm [rows, n m], likewise.
    pub sum: Option<Matrix>,
    /// Of the norm [rows n, 2].
    pub stats: Matrix,
    /// Gradients inside, likewise.
    pub store: Option<Store>,
}

/// Where the interaction's gradients lie for its weights: of the sum before the norm, then q, k and v.
#[derive(Debug, Clone, Copy)]
pub struct Store {
    /// All, with this row's part of the sums first.
    pub at: Matrix,
    /// From this row's part of the sums to those of q, k and v, in numbers.
    pub distances: [usize; 3],
}

impl Tape {
    /// The interaction of some rows: e [rows, n m] from z [rows, n m] and u [rows, (n+k) m].
    pub fn interaction_step(&mut self, parts: &Interaction, classes: usize, at: Attending) {
        let Attending { z, u, e, mix, sum, stats, store } = at;
        let (m, parts) = (classes, *parts);
        let (n, r) = (z.cols / m, u.cols / m);
        let layers = [parts.query, parts.key, parts.value, parts.output];
        let weights: Vec<Pointer> =
            layers.iter().flat_map(|l| [l.weight.value.into(), l.bias.value.into()]).collect();
        // As `layout` in `kernels/interaction.c` has it.
        let (even, odd, across) = (m + 4, m + 1, r + 4);
        let floats = (3 * n + r) * even + n * across + (4 * m + 2 * r) * odd + 4;
        let threads = (n / 4 * m).next_multiple_of(32).clamp(256, 512);
        let grid = Grid { blocks: z.rows, threads, shared_bytes: 4 * floats };
        let norm = [parts.norm.gain.value, parts.norm.shift.value, e].map(Pointer::from);
        let p =
            [&[z.into(), u.into()][..], &weights, &norm, &[mix.into(), sum.into(), stats.into()]].concat();
        let counts = [z.rows, n, r, m, z.stride, u.stride, e.stride];
        self.program.kernel(Kernel::InteractionForward, grid, &p, &counts, &[parts.norm.eps]);
        self.on_backward(move |tape| {
            let de = tape.gradient_of(e);
            let dz = tape.gradient_sum(z);
            let du = tape.gradient_overwritten(u);
            let floats = floats + (3 * n + 2 * r) * even + n * across;
            let grid = Grid { shared_bytes: 4 * floats, ..grid };
            let gradients = [parts.norm.gain.value, stats, de, dz, du].map(Pointer::from);
            let store_at = store.map_or(Pointer::NULL, |store| store.at.pointer());
            let p = [&[z.into(), u.into()][..], &weights, &gradients, &[store_at]].concat();
            let distances = store.map_or([0; 3], |store| store.distances);
            let n = [&[z.rows, n, r, m, z.stride, u.stride, de.stride, dz.stride, du.stride][..], &distances]
                .concat();
            tape.program.kernel(Kernel::InteractionBackward, grid, &p, &n, &[]);
        });
    }

    /// Collects the gradients of the interaction's weights but `deter`'s over all rows.
    pub fn collect_interaction(&mut self, parts: &Interaction, classes: usize, all: Attending) {
        let (parts, m) = (*parts, classes);
        let (Some(mix), Some(sum), Some(store)) = (all.mix, all.sum, all.store) else { return };
        self.on_backward(move |tape| {
            let (rows, n, r) = (all.z.rows, all.z.cols / m, all.u.cols / m);
            let at = |distance: usize, rows: usize| Matrix {
                offset: store.at.offset + distance,
                rows,
                cols: m,
                stride: m,
                ..store.at
            };
            let [q, k, v] = store.distances;
            let flat = |x: Matrix| x.reshape(x.len() / m, m);
            let (z, u) = (flat(all.z), flat(all.u));
            let pairs = [
                (parts.output, at(0, rows * n), flat(mix)),
                (parts.query, at(q, rows * n), z),
                (parts.key, at(k, rows * r), u),
                (parts.value, at(v, rows * r), u),
            ];
            for (layer, d, x) in pairs {
                let (Some(weight), Some(bias)) = (layer.weight.gradient, layer.bias.gradient) else {
                    continue;
                };
                tape.product((d, true), (x, false), weight, true);
                tape.add_column_sums(d, bias);
            }
            let de = tape.gradient_of(all.e);
            tape.add_norm_gradients(flat(sum), parts.norm, all.stats, flat(de), false);
        });
    }
}
