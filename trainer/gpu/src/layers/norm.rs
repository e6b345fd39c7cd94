//! LayerNorm on a tape.

use super::{NARROW_BLOCKS, Norm, stats_of};
use crate::machine::Kernel;
use crate::program::{Grid, Matrix, Pointer};
use crate::tape::{Tape, chunks_of};

impl Tape {
    /// LayerNorm of rows, then `SiLU` where `silu`, all at once.
    pub fn norm(&mut self, x: Matrix, norm: Norm, y: Matrix, silu: bool) {
        let stats = stats_of(self, x.rows);
        let fits = x.cols.is_power_of_two() && (4..=128).contains(&x.cols);
        if silu && fits && x.is_contiguous() && y.is_contiguous() {
            return self.narrow_norm(x, norm, stats, y);
        }
        self.collect_norm(x, norm, stats, y, silu);
        self.norm_step(x, norm, stats, y, silu);
    }

    /// The same of narrow rows, which is what maps have.
    fn narrow_norm(&mut self, x: Matrix, norm: Norm, stats: Matrix, y: Matrix) {
        const THREADS: usize = 256;
        let blocks = (x.rows * (x.cols / 4)).div_ceil(THREADS).clamp(1, NARROW_BLOCKS);
        let grid = Grid { blocks, threads: THREADS, shared_bytes: 0 };
        let p = [x, norm.gain.value, norm.shift.value, y, stats].map(Pointer::from);
        self.program.kernel(Kernel::NarrowForward, grid, &p, &[x.rows, x.cols], &[norm.eps]);
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            let (dx, add) = tape.gradient_term(x);
            let partial = norm.gain.gradient.map(|_| tape.matrix(blocks * 2, x.cols));
            let p = [x, norm.gain.value, norm.shift.value, stats, dy, dx].map(Pointer::from);
            let p = [&p[..], &[partial.into()]].concat();
            let grid = Grid { shared_bytes: 32 * THREADS, ..grid };
            tape.program.kernel(Kernel::NarrowBackward, grid, &p, &[x.rows, x.cols, usize::from(add)], &[]);
            if let (Some(partial), Some(gain), Some(shift)) =
                (partial, norm.gain.gradient, norm.shift.gradient)
            {
                tape.add_partials(partial.pointer(), gain, blocks, 2 * x.cols, 0);
                tape.add_partials(partial.pointer(), shift, blocks, 2 * x.cols, x.cols);
            }
        });
    }

    /// The same of some of the rows, whose gain and shift are collected apart.
    pub fn norm_step(&mut self, x: Matrix, norm: Norm, stats: Matrix, y: Matrix, silu: bool) {
        let (grid, wide) = Grid::rows(x.rows, x.cols);
        let p = [x.into(), norm.gain.value.into(), norm.shift.value.into(), y.into(), stats.into()];
        let n = [x.rows, x.cols, x.stride, y.stride, usize::from(silu), usize::from(wide)];
        self.program.kernel(Kernel::NormForward, grid, &p, &n, &[norm.eps]);
        self.on_backward(move |tape| {
            let dy = tape.gradient_of(y);
            let (dx, add) = tape.gradient_term(x);
            let p = [x, norm.gain.value, norm.shift.value, stats, dy, dx].map(Pointer::from);
            let flags = [usize::from(silu), usize::from(add), usize::from(wide)];
            let n = [&[x.rows, x.cols, x.stride, dy.stride, dx.stride][..], &flags].concat();
            tape.program.kernel(Kernel::NormBackward, grid, &p, &n, &[]);
        });
    }

    /// Collects the gradients of gain and shift over all rows.
    pub fn collect_norm(&mut self, x: Matrix, norm: Norm, stats: Matrix, y: Matrix, silu: bool) {
        self.on_backward(move |tape| {
            if norm.gain.gradient.is_some() {
                let dy = tape.gradient_of(y);
                tape.add_norm_gradients(x, norm, stats, dy, silu);
            }
        });
    }

    pub(super) fn add_norm_gradients(
        &mut self,
        x: Matrix,
        norm: Norm,
        stats: Matrix,
        dy: Matrix,
        silu: bool,
    ) {
        let (Some(gain), Some(shift)) = (norm.gain.gradient, norm.shift.gradient) else { return };
        let (chunks, rows) = chunks_of(x.rows);
        let partial = self.matrix(chunks * 2, x.cols);
        let p = [x, norm.gain.value, norm.shift.value, stats, dy, partial].map(Pointer::from);
        let n = [x.rows, x.cols, x.stride, dy.stride, usize::from(silu), rows];
        let grid = Grid { blocks: chunks * x.cols.div_ceil(32), threads: 256, shared_bytes: 0 };
        self.program.kernel(Kernel::NormParameters, grid, &p, &n, &[]);
        self.add_partials(partial.pointer(), gain, chunks, 2 * x.cols, 0);
        self.add_partials(partial.pointer(), shift, chunks, 2 * x.cols, x.cols);
    }
}
