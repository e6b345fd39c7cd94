//! One thread's way through a stack of convolutions, image by image.

use std::ops::Range;

use pulp::Arch;

use rcwm_kernels::batch::conv::{
    DoublePanels, Map, double, double_panels, halve, halve_panels, pad, weight_grads,
};
use rcwm_kernels::batch::norm::{self, Norm, NormGrads, add, add_rows, add_to_rows};
use rcwm_kernels::batch::tile::{PANEL, Panels};

/// What a stack does to the sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Convolution: halves them.
    Down,
    /// Transposed convolution: doubles them.
    Up,
}

/// Weights as the kernel of a direction wants them.
enum Weights {
    Halve(Panels),
    Double(DoublePanels),
}

/// One layer with its weights laid out.
pub struct Layer<'a> {
    weights: Weights,
    norm: Option<Norm<'a>>,
    bias: Option<&'a [f32]>,
    from: Map,
    to: Map,
}

impl<'a> Layer<'a> {
    /// For a backward pass the weights are laid out for the input's gradient, which is the other direction's kernel on the
    /// same numbers.
    pub fn new(
        direction: Direction,
        weight: &[f32],
        norm: Option<Norm<'a>>,
        bias: Option<&'a [f32]>,
        from: Map,
        to: Map,
        backward: bool,
    ) -> Self {
        let second = if direction == Direction::Down { from.channels } else { to.channels };
        let at =
            |a: usize, b: usize, row: usize, column: usize| weight[(a * second + b) * 16 + row * 4 + column];
        let weights = match (direction, backward) {
            (Direction::Down, false) => Weights::Halve(halve_panels(from.channels, to.channels, at)),
            (Direction::Up, true) => Weights::Halve(halve_panels(to.channels, from.channels, at)),
            (Direction::Up, false) => Weights::Double(double_panels(from.channels, to.channels, at)),
            (Direction::Down, true) => Weights::Double(double_panels(to.channels, from.channels, at)),
        };
        Self { weights, norm, bias, from, to }
    }

    fn convolve(&self, arch: Arch, padded: &[f32], map: Map, y: &mut [f32]) {
        match &self.weights {
            Weights::Halve(panels) => halve(arch, padded, map, panels, y),
            Weights::Double(panels) => double(arch, padded, map, panels, y),
        }
    }
}

/// All layers.
pub struct Pass<'a> {
    pub arch: Arch,
    pub direction: Direction,
    pub layers: Vec<Layer<'a>>,
}

/// Gradients of all parameters, summed over images.
pub struct Gradients {
    /// [16 * channels of the larger map, channels of the smaller].
    pub weights: Vec<Vec<f32>>,
    pub norms: Vec<NormGrads>,
    pub biases: Vec<Vec<f32>>,
}

impl Gradients {
    pub fn new(maps: &[Map], normed: impl Iterator<Item = bool>) -> Self {
        let layers = || maps.windows(2);
        let width = |(maps, normed): (&[Map], bool)| if normed { maps[1].channels } else { 0 };
        Self {
            weights: layers().map(|maps| vec![0.0; 16 * maps[0].channels * maps[1].channels]).collect(),
            norms: layers().zip(normed).map(|layer| NormGrads::new(width(layer))).collect(),
            biases: layers().map(|maps| vec![0.0; maps[1].channels]).collect(),
        }
    }

    pub fn add(&mut self, other: &Self) {
        self.weights.iter_mut().zip(&other.weights).for_each(|(sum, term)| add(sum, term));
        self.norms.iter_mut().zip(&other.norms).for_each(|(sum, term)| sum.add(term));
        self.biases.iter_mut().zip(&other.biases).for_each(|(sum, term)| add(sum, term));
    }
}

/// Buffers of one thread's backward pass.
pub struct Scratch {
    /// The map of a layer's input, or of its output, with a border: by layer.
    padded_from: Vec<Vec<f32>>,
    padded_to: Vec<Vec<f32>>,
    /// A layer's input.
    input: Vec<f32>,
    /// Gradient of a layer's output before its norm.
    d_pre: Vec<f32>,
    /// Gradient of a layer's output.
    d_out: Vec<f32>,
}

impl Scratch {
    pub fn new(layers: &[Layer<'_>]) -> Self {
        let largest =
            layers.iter().flat_map(|layer| [layer.from.numbers(), layer.to.numbers()]).max().unwrap_or(0);
        let buffer = || vec![0.0; largest + PANEL];
        Self {
            padded_from: layers.iter().map(|layer| vec![0.0; layer.from.padded_len()]).collect(),
            padded_to: layers.iter().map(|layer| vec![0.0; layer.to.padded_len()]).collect(),
            input: buffer(),
            d_pre: buffer(),
            d_out: buffer(),
        }
    }
}

impl Pass<'_> {
    /// Images `x` to `out`; `pre` has every normed layer's output before the norm, of all images if they are to be kept, else of one.
    pub fn forward(&self, x: &[f32], mut pre: Vec<&mut [f32]>, keep: bool, out: &mut [f32]) {
        let Some((first, last)) = self.layers.first().zip(self.layers.last()) else { return };
        let mut scratch = Scratch::new(&self.layers);
        let images = x.chunks_exact(first.from.numbers()).zip(out.chunks_exact_mut(last.to.numbers()));
        for (image, (x, out)) in images.enumerate() {
            pad(x, first.from, &mut scratch.padded_from[0]);
            for (index, layer) in self.layers.iter().enumerate() {
                let padded = &scratch.padded_from[index];
                let size = layer.to.numbers();
                let Some(norm) = layer.norm else {
                    layer.convolve(self.arch, padded, layer.from, out);
                    if let Some(bias) = layer.bias {
                        add_to_rows(out, bias);
                    }
                    continue;
                };
                let place = if keep { image * size } else { 0 };
                let pre = &mut pre[index][place..place + size];
                layer.convolve(self.arch, padded, layer.from, pre);
                if index + 1 == self.layers.len() {
                    norm::forward(pre, norm, out);
                } else {
                    let activated = &mut scratch.input[..size];
                    norm::forward(pre, norm, activated);
                    pad(activated, layer.to, &mut scratch.padded_from[index + 1]);
                }
            }
        }
    }

    /// Adds the gradients of the parameters over the images of `share` to `sums`, and writes those of the images to `dx` unless it is empty.
    #[allow(clippy::too_many_arguments)]
    pub fn backward(
        &self,
        x: &[f32],
        pre: &[Vec<f32>],
        d_out: &[f32],
        share: Range<usize>,
        dx: &mut [f32],
        sums: &mut Gradients,
        scratch: &mut Scratch,
    ) {
        for (place, image) in share.enumerate() {
            let last = self.layers.len() - 1;
            let size = self.layers[last].to.numbers();
            scratch.d_out[..size].copy_from_slice(&d_out[image * size..][..size]);
            for index in (0..self.layers.len()).rev() {
                let input_size = self.layers[index].from.numbers();
                match index.checked_sub(1).and_then(|before| Some((before, self.layers[before].norm?))) {
                    Some((before, norm)) => {
                        norm::forward(
                            &pre[before][image * input_size..][..input_size],
                            norm,
                            &mut scratch.input[..input_size],
                        );
                    }
                    None => {
                        scratch.input[..input_size].copy_from_slice(&x[image * input_size..][..input_size])
                    }
                }
                let pre = pre.get(index).map(|pre| &pre[image * self.layers[index].to.numbers()..]);
                self.layer_backward(index, pre, sums, scratch);
                let d_input = if index > 0 {
                    &mut scratch.d_out[..input_size]
                } else if dx.is_empty() {
                    continue;
                } else {
                    &mut dx[place * input_size..][..input_size]
                };
                let layer = &self.layers[index];
                layer.convolve(self.arch, &scratch.padded_to[index], layer.to, d_input);
            }
        }
    }

    /// From the gradient in `d_out` to the padded one before the norm, and the gradients of the layer's parameters.
    fn layer_backward(&self, index: usize, pre: Option<&[f32]>, sums: &mut Gradients, scratch: &mut Scratch) {
        let layer = &self.layers[index];
        let size = layer.to.numbers();
        let Scratch { padded_from, padded_to, input, d_pre, d_out } = scratch;
        match (layer.norm, pre) {
            (Some(norm), Some(pre)) => {
                norm::backward(
                    &pre[..size],
                    norm,
                    &d_out[..size],
                    &mut d_pre[..size],
                    &mut sums.norms[index],
                );
            }
            _ => d_pre[..size].copy_from_slice(&d_out[..size]),
        }
        if layer.bias.is_some() {
            add_rows(&mut sums.biases[index], &d_pre[..size]);
        }
        pad(&d_pre[..size], layer.to, &mut padded_to[index]);
        let grads = &mut sums.weights[index];
        match self.direction {
            Direction::Down => {
                pad(&input[..layer.from.numbers()], layer.from, &mut padded_from[index]);
                weight_grads(self.arch, &padded_from[index], layer.from, d_pre, layer.to.channels, grads);
            }
            Direction::Up => {
                weight_grads(self.arch, &padded_to[index], layer.to, input, layer.from.channels, grads);
            }
        }
    }
}
