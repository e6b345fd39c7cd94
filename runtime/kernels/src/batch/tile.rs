//! The inner loop of every small or strided product: convolutions without a copy of their windows, and layers on few rows.
//!
//! gemm libraries copy ("pack") both factors before they multiply, which costs more than the product where one side has only
//! 8 to 64 columns. Here one factor is read in place by broadcasts, at any stride, the other as full vectors, and up to 8 x 16 sums stay
//! in registers.

use pulp::{Arch, Simd, WithSimd};

/// Columns of a panel: the second factor is laid out in panels of this width (the last may have 8).
pub const PANEL: usize = 16;

/// `dst[p * dst_stride + lane] (+)= sum over (run, step) of a[p * a_place + run * a_run + step * a_step] * w[run * w_run + step * w_step + lane]`
/// for `p < places` and `lane < lanes`.
///
/// With the places along a row of an image and the steps along (column, channel), this is a convolution; with the places along
/// (column, channel) and the steps along a row it is the gradient of its weights.
#[derive(Debug, Clone, Copy)]
pub struct Job<'a> {
    /// The factor that is read one number at a time.
    pub a: &'a [f32],
    /// Distance of two places in `a`.
    pub a_place: usize,
    /// Distance of two runs in `a`.
    pub a_run: usize,
    /// Distance of two steps in `a`.
    pub a_step: usize,
    /// The factor that is read a vector at a time; 8 or 16 numbers of it are read at every step, whatever `lanes` is.
    pub w: &'a [f32],
    /// Distance of two runs in `w`.
    pub w_run: usize,
    /// Distance of two steps in `w`.
    pub w_step: usize,
    /// Number of runs.
    pub runs: usize,
    /// Steps of a run.
    pub steps: usize,
    /// Number of places.
    pub places: usize,
    /// Sums of a place that are wanted: at most [`PANEL`].
    pub lanes: usize,
    /// Distance of two places in `dst`.
    pub dst_stride: usize,
    /// Whether to add to what is in `dst`.
    pub add: bool,
}

impl Job<'_> {
    /// Vector width that is read: 8 where that suffices.
    fn width(&self) -> usize {
        if self.lanes <= 8 { 8 } else { PANEL }
    }

    /// Panics unless everything that [`Job::run`] reads and writes lies within the slices.
    fn check(&self, dst: &[f32]) {
        assert!(self.lanes <= PANEL, "tile: {} lanes, at most {PANEL} fit", self.lanes);
        let (runs, steps, places) = (self.runs - 1, self.steps - 1, self.places - 1);
        let a_last = places * self.a_place + runs * self.a_run + steps * self.a_step;
        let w_last = runs * self.w_run + steps * self.w_step + self.width();
        assert!(a_last < self.a.len(), "tile: reads entry {a_last} of {}", self.a.len());
        assert!(w_last <= self.w.len(), "tile: reads {w_last} weights of {}", self.w.len());
        let dst_last = places * self.dst_stride + self.lanes;
        assert!(dst_last <= dst.len(), "tile: writes {dst_last} entries of {}", dst.len());
    }

    /// Does it. `2 * runs * steps * places * width` flops.
    ///
    /// # Panics
    /// If the slices are too short for the strides; a programming error.
    pub fn run(&self, arch: Arch, dst: &mut [f32]) {
        if self.places == 0 || self.lanes == 0 {
            return;
        }
        if self.runs == 0 || self.steps == 0 {
            if !self.add {
                (0..self.places).for_each(|p| dst[p * self.dst_stride..][..self.lanes].fill(0.0));
            }
            return;
        }
        self.check(dst);
        match (arch, self.width()) {
            // Eight lanes are one AVX2 vector: AVX-512's would be half empty.
            #[cfg(target_arch = "x86_64")]
            (Arch::V4(simd), 8) => Arch::V3(*simd).dispatch(Kernel { job: self, dst }),
            _ => arch.dispatch(Kernel { job: self, dst }),
        }
    }
}

struct Kernel<'a, 'b> {
    job: &'a Job<'b>,
    dst: &'a mut [f32],
}

impl WithSimd for Kernel<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match (S::F32_LANES, self.job.width()) {
            (16, _) | (8, 8) => self.places::<S, 8, 1>(simd),
            (8, _) => self.places::<S, 4, 2>(simd),
            (4, 8) => self.places::<S, 4, 2>(simd),
            (4, _) => self.places::<S, 2, 4>(simd),
            (_, 8) => self.places::<S, 1, 8>(simd),
            _ => self.places::<S, 1, 16>(simd),
        }
    }
}

impl Kernel<'_, '_> {
    /// All places, `P` at a time with `V` vectors each; what is left over by halves.
    #[inline(always)]
    fn places<S: Simd, const P: usize, const V: usize>(self, simd: S) {
        let (job, dst) = (self.job, self.dst);
        let mut p = 0;
        while p + P <= job.places {
            tile::<S, P, V>(simd, job, p, dst);
            p += P;
        }
        if P > 4 && p + 4 <= job.places {
            tile::<S, 4, V>(simd, job, p, dst);
            p += 4;
        }
        if P > 2 && p + 2 <= job.places {
            tile::<S, 2, V>(simd, job, p, dst);
            p += 2;
        }
        while p < job.places {
            tile::<S, 1, V>(simd, job, p, dst);
            p += 1;
        }
    }
}

/// `P` places from place `first`.
#[inline(always)]
fn tile<S: Simd, const P: usize, const V: usize>(simd: S, job: &Job<'_>, first: usize, dst: &mut [f32]) {
    let mut sums = [[simd.splat_f32s(0.0); V]; P];
    for run in 0..job.runs {
        // SAFETY: `Job::check` has made sure that the largest offset of any place, run and step lies within both slices, and
        // that a whole vector of `w` can be read there; `first + P <= places`. A pulp vector is plain lanes of f32, read unaligned.
        unsafe {
            let mut a = job.a.as_ptr().add(first * job.a_place + run * job.a_run);
            let mut w = job.w.as_ptr().add(run * job.w_run);
            for _ in 0..job.steps {
                let mut row = [simd.splat_f32s(0.0); V];
                for (v, vector) in row.iter_mut().enumerate() {
                    *vector = w.add(v * S::F32_LANES).cast::<S::f32s>().read_unaligned();
                }
                for (p, sums) in sums.iter_mut().enumerate() {
                    let value = simd.splat_f32s(*a.add(p * job.a_place));
                    for (sum, vector) in sums.iter_mut().zip(row) {
                        *sum = simd.mul_add_f32s(value, vector, *sum);
                    }
                }
                a = a.wrapping_add(job.a_step);
                w = w.wrapping_add(job.w_step);
            }
        }
    }
    for (p, sums) in sums.iter().enumerate() {
        let out = &mut dst[(first + p) * job.dst_stride..][..job.lanes];
        store::<S, V>(simd, sums, out, job.add);
    }
}

/// Writes or adds as many lanes as `out` has.
#[inline(always)]
fn store<S: Simd, const V: usize>(simd: S, sums: &[S::f32s; V], out: &mut [f32], add: bool) {
    let mut rest = out;
    for sum in sums {
        let count = rest.len().min(S::F32_LANES);
        let (now, later) = rest.split_at_mut(count);
        let value = if add { simd.add_f32s(simd.partial_load_f32s(now), *sum) } else { *sum };
        simd.partial_store_f32s(now, value);
        rest = later;
    }
}

/// A matrix [steps, columns] in panels: panel by panel, step by step, [`PANEL`] columns (8 in the last where that suffices).
#[derive(Debug, Clone, Default)]
pub struct Panels {
    data: Vec<f32>,
    /// Rows of the matrix.
    pub steps: usize,
    /// Columns of the matrix.
    pub columns: usize,
}

impl Panels {
    /// Lays out the matrix whose entry (step, column) is `at(step, column)`.
    pub fn new(steps: usize, columns: usize, at: impl Fn(usize, usize) -> f32) -> Self {
        let mut data = Vec::with_capacity(steps * columns.next_multiple_of(8));
        for first in (0..columns).step_by(PANEL) {
            let width = Self::width(columns - first);
            for step in 0..steps {
                let column = |lane: usize| if first + lane < columns { at(step, first + lane) } else { 0.0 };
                data.extend((0..width).map(column));
            }
        }
        Self { data, steps, columns }
    }

    fn width(columns: usize) -> usize {
        if columns <= 8 { 8 } else { PANEL }
    }

    /// The panels: first column, wanted columns, width, and their entries [steps, width].
    pub fn iter(&self) -> impl Iterator<Item = (usize, usize, usize, &[f32])> {
        (0..self.columns).step_by(PANEL).map(|first| {
            let left = self.columns - first;
            let width = Self::width(left);
            (first, left.min(PANEL), width, &self.data[first * self.steps..][..self.steps * width])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_job_is_the_sum_it_says(
            runs in 0usize..3, steps in 0usize..7, places in 0usize..12, lanes in 0usize..=16,
            a_place in 1usize..5, a_run in 0usize..9, a_step in 1usize..4, add: bool,
        ) {
            let (w_step, dst_stride) = (17, 20);
            let a: Vec<f32> = (0..200).map(|i| (i % 13) as f32 - 6.0).collect();
            let w: Vec<f32> = (0..400).map(|i| (i % 7) as f32 - 3.0).collect();
            let job = Job { a: &a, a_place, a_run, a_step, w: &w, w_run: 100, w_step, runs, steps, places, lanes, dst_stride, add };
            let before: Vec<f32> = (0..260).map(|i| i as f32).collect();
            for arch in [Arch::new(), Arch::Scalar] {
                let mut found = before.clone();
                job.run(arch, &mut found);
                let mut expected = before.clone();
                for p in 0..places {
                    for lane in 0..lanes {
                        let at = p * dst_stride + lane;
                        let terms = (0..runs).flat_map(|r| (0..steps).map(move |s| (r, s)));
                        let sum: f32 = terms
                            .map(|(r, s)| a[p * a_place + r * a_run + s * a_step] * w[r * 100 + s * w_step + lane])
                            .sum();
                        expected[at] = if add { before[at] + sum } else { sum };
                    }
                }
                prop_assert_eq!(&found, &expected);
            }
        }

        #[test]
        fn panels_hold_the_matrix_and_zeros(steps in 1usize..9, columns in 1usize..40) {
            let at = |step: usize, column: usize| (step * 100 + column + 1) as f32;
            let panels = Panels::new(steps, columns, at);
            for (first, lanes, width, panel) in panels.iter() {
                for (index, value) in panel.iter().enumerate() {
                    let (step, lane) = (index / width, index % width);
                    prop_assert_eq!(*value, if lane < lanes { at(step, first + lane) } else { 0.0 });
                }
            }
            prop_assert_eq!(panels.iter().map(|(_, lanes, ..)| lanes).sum::<usize>(), columns);
        }
    }
}
