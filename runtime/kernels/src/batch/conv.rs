//! Convolutions of kernel 4, stride 2, padding 1, channels last, one image at a time.
//!
//! In a padded image whose channels come last, the four columns that a window sees are contiguous, and so are the two that an
//! output of the transposed convolution sees: both are sums over runs of a row, read in place. Each is also the other's input gradient, so
//! there are three kernels: halve, double, and the gradient of the weights.

use pulp::Arch;

use super::tile::{Job, PANEL, Panels};

/// Sides and channels of a feature map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Map {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    pub channels: usize,
}

impl Map {
    pub fn numbers(self) -> usize {
        self.height * self.width * self.channels
    }

    /// Numbers in it with a border of one pixel of zeros, and room for reading one vector beyond.
    pub fn padded_len(self) -> usize {
        (self.height + 2) * (self.width + 2) * self.channels + PANEL
    }

    /// Numbers in a row with its border.
    fn padded_row(self) -> usize {
        (self.width + 2) * self.channels
    }
}

/// Copies `x` (a `map`) into the middle of `padded`, whose border is zero and stays so.
pub fn pad(x: &[f32], map: Map, padded: &mut [f32]) {
    let row = map.width * map.channels;
    for (from, to) in x.chunks_exact(row).zip(padded.chunks_exact_mut(map.padded_row()).skip(1)) {
        to[map.channels..][..row].copy_from_slice(from);
    }
}

/// Weights for [`halve`], from `weight(out, in, row, column)`; steps run over (row, column, in).
pub fn halve_panels(
    inputs: usize,
    outputs: usize,
    weight: impl Fn(usize, usize, usize, usize) -> f32,
) -> Panels {
    Panels::new(16 * inputs, outputs, |step, out| {
        let (place, input) = (step / inputs, step % inputs);
        weight(out, input, place / 4, place % 4)
    })
}

/// `y` [H/2, W/2, out] of a padded `x`. `32 H/2 W/2 in out` flops.
pub fn halve(arch: Arch, padded: &[f32], from: Map, panels: &Panels, y: &mut [f32]) {
    let (height, width, run) = (from.height / 2, from.width / 2, 4 * from.channels);
    for (first, lanes, w_step, w) in panels.iter() {
        for row in 0..height {
            let job = Job {
                a: &padded[2 * row * from.padded_row()..],
                a_place: 2 * from.channels,
                a_run: from.padded_row(),
                a_step: 1,
                w,
                w_run: run * w_step,
                w_step,
                runs: 4,
                steps: run,
                places: width,
                lanes,
                dst_stride: panels.columns,
                add: false,
            };
            job.run(arch, &mut y[row * width * panels.columns + first..]);
        }
    }
}

/// Weights for [`double`]: one set of panels per phase of the output, or per row phase where the columns' phases share vectors.
#[derive(Debug, Clone)]
pub struct DoublePanels {
    phases: Vec<Panels>,
    outputs: usize,
    /// Both column phases side by side in one vector of 8, over the three columns that either sees.
    merged: bool,
}

/// Weights for [`double`], from `weight(in, out, row, column)`. Output row `2p + a` takes kernel row `3 - a - 2i` from input row
/// `p + a + i - 1`, and columns alike.
pub fn double_panels(
    inputs: usize,
    outputs: usize,
    weight: impl Fn(usize, usize, usize, usize) -> f32,
) -> DoublePanels {
    let merged = outputs <= 4;
    let phase = |a: usize, b: usize| {
        Panels::new(4 * inputs, outputs, |step, out| {
            let (place, input) = (step / inputs, step % inputs);
            weight(input, out, 3 - a - 2 * (place / 2), 3 - b - 2 * (place % 2))
        })
    };
    let both = |a: usize| {
        Panels::new(6 * inputs, 2 * outputs, |step, lane| {
            let (place, input) = (step / inputs, step % inputs);
            let (b, out) = (lane / outputs, lane % outputs);
            match (place % 3).checked_sub(b) {
                Some(j) if j < 2 => weight(input, out, 3 - a - 2 * (place / 3), 3 - b - 2 * j),
                _ => 0.0,
            }
        })
    };
    let phases = if merged {
        (0..2).map(both).collect()
    } else {
        [(0, 0), (0, 1), (1, 0), (1, 1)].into_iter().map(|(a, b)| phase(a, b)).collect()
    };
    DoublePanels { phases, outputs, merged }
}

/// `y` [2H, 2W, out] of a padded `x`. `32 H W in out` flops, half more where both column phases share vectors.
pub fn double(arch: Arch, padded: &[f32], from: Map, panels: &DoublePanels, y: &mut [f32]) {
    let outputs = panels.outputs;
    for (index, phase) in panels.phases.iter().enumerate() {
        let (a, b) = if panels.merged { (index, 0) } else { (index / 2, index % 2) };
        let run = phase.steps / 2;
        for (first, lanes, w_step, w) in phase.iter() {
            for row in 0..from.height {
                let job = Job {
                    a: &padded[(row + a) * from.padded_row() + b * from.channels..],
                    a_place: from.channels,
                    a_run: from.padded_row(),
                    a_step: 1,
                    w,
                    w_run: run * w_step,
                    w_step,
                    runs: 2,
                    steps: run,
                    places: from.width,
                    lanes,
                    dst_stride: 2 * outputs,
                    add: false,
                };
                let to = ((2 * row + a) * 2 * from.width + b) * outputs + first;
                job.run(arch, &mut y[to..]);
            }
        }
    }
}

/// Adds to `grads` [16 * large.channels, channels] (as row, column, channel of the large map) the products of the padded large map
/// with the `small` map of half its sides: the gradient of the weights of [`halve`] (small: the output's gradient) and of [`double`] (small: the
/// input). `small` must have room for reading one vector beyond. `32 H/2 W/2 in out` flops.
pub fn weight_grads(
    arch: Arch,
    padded: &[f32],
    large: Map,
    small: &[f32],
    channels: usize,
    grads: &mut [f32],
) {
    let run = 4 * large.channels;
    for row in 0..4 {
        for first in (0..channels).step_by(PANEL) {
            let job = Job {
                a: &padded[row * large.padded_row()..],
                a_place: 1,
                a_run: 2 * large.padded_row(),
                a_step: 2 * large.channels,
                w: &small[first..],
                w_run: large.width / 2 * channels,
                w_step: channels,
                runs: large.height / 2,
                steps: large.width / 2,
                places: run,
                lanes: (channels - first).min(PANEL),
                dst_stride: channels,
                add: true,
            };
            job.run(arch, &mut grads[row * run * channels + first..]);
        }
    }
}
