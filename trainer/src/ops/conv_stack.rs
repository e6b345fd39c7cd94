//! Stacks of convolutions as one op: an image goes through all layers while it is in the cache.

use std::ops::Range;

use candle_core::{DType, Device, Result, Tensor};
use pulp::Arch;

use super::composite;
use super::conv_pass::{Direction, Gradients, Layer, Pass, Scratch};
use super::node::{Backward, Floats, floats, mismatch, record_one};
use super::parallel;
use rcwm_kernels::batch::conv::Map;
use rcwm_kernels::batch::norm::Norm;

/// One convolution and what follows it.
#[derive(Debug, Clone, Copy)]
pub struct ConvLayer<'a> {
    /// [out, in, 4, 4] where sides are halved, [in, out, 4, 4] where they are doubled.
    pub weight: &'a Tensor,
    /// LayerNorm over channels and `SiLU`: gain and shift [out], and the epsilon.
    pub norm: Option<(&'a Tensor, &'a Tensor, f64)>,
    /// Added to the output, [out]; not together with a norm.
    pub bias: Option<&'a Tensor>,
}

impl<'a> ConvLayer<'a> {
    /// The convolution alone.
    #[must_use]
    pub fn bare(weight: &'a Tensor) -> Self {
        Self { weight, norm: None, bias: None }
    }

    /// What follows the convolution, out of candle's operations.
    pub(super) fn finish(&self, y: Tensor) -> Result<Tensor> {
        let y = match self.bias {
            Some(bias) => y.broadcast_add(bias)?,
            None => y,
        };
        match self.norm {
            Some((weight, bias, eps)) => composite::layer_norm_silu(&y, weight, bias, eps),
            None => Ok(y),
        }
    }
}

impl Direction {
    const fn name(self) -> &'static str {
        match self {
            Self::Down => "conv-down",
            Self::Up => "conv-up",
        }
    }

    /// The map a layer makes of a map; none where they do not fit.
    fn map_after(self, from: Map, weight: &Tensor) -> Option<Map> {
        let [first, second, 4, 4] = *weight.dims() else { return None };
        let fits = from.height > 0 && from.width > 0 && first > 0 && second > 0;
        match self {
            Self::Down
                if second == from.channels
                    && fits
                    && [from.height, from.width].iter().all(|side| side.is_multiple_of(2)) =>
            {
                Some(Map { height: from.height / 2, width: from.width / 2, channels: first })
            }
            Self::Up if first == from.channels && fits => {
                Some(Map { height: 2 * from.height, width: 2 * from.width, channels: second })
            }
            _ => None,
        }
    }
}

/// Least work of a share, in numbers of the input.
const SHARE_NUMBERS_MIN: usize = 8_192;

/// Applies the layers to `x` [B, H, W, C], f32 on the CPU.
pub fn stack(direction: Direction, x: &Tensor, layers: &[ConvLayer<'_>]) -> Result<Tensor> {
    let Applied { inputs, out, shape, kept } = apply(direction, x, layers)?;
    record_one(&inputs.iter().collect::<Vec<_>>(), out, shape, kept)
}

/// A stack's results outside candle's graph.
pub struct Applied {
    /// x, then every layer's weight, gain and shift or bias.
    pub inputs: Vec<Tensor>,
    /// The last layer's output.
    pub out: Vec<f32>,
    pub shape: (usize, usize, usize, usize),
    /// For the way back.
    pub kept: Kept,
}

/// Applies the layers without putting the result into candle's graph.
pub fn apply(direction: Direction, x: &Tensor, layers: &[ConvLayer<'_>]) -> Result<Applied> {
    let op = direction.name();
    let (batch, height, width, channels) = x.dims4()?;
    let mut maps = vec![Map { height, width, channels }];
    let mut inputs = vec![x.contiguous()?];
    let mut kept = Vec::with_capacity(layers.len());
    let mut from = maps[0];
    for (index, layer) in layers.iter().enumerate() {
        let Some(to) = direction.map_after(from, layer.weight) else { return mismatch(op, x, layer.weight) };
        let parameters =
            [layer.norm.map(|(gain, _, _)| gain), layer.norm.map(|(_, shift, _)| shift), layer.bias];
        if let Some(wrong) =
            parameters.into_iter().flatten().find(|p| p.dims() != [to.channels] || p.dtype() != DType::F32)
        {
            return mismatch(op, layer.weight, wrong);
        }
        if layer.norm.is_none() && index + 1 < layers.len() || layer.norm.is_some() && layer.bias.is_some() {
            candle_core::bail!(
                "{op}: layer {index} of {}: a norm must follow every layer but the last, and no bias with it",
                layers.len()
            );
        }
        inputs.push(layer.weight.contiguous()?);
        let eps = layer.norm.map(|(gain, shift, eps)| {
            inputs.extend([gain.clone(), shift.clone()]);
            eps as f32
        });
        inputs.extend(layer.bias.cloned());
        kept.push(KeptLayer {
            weight: layer.weight.detach().contiguous()?,
            norm: layer.norm.map(|(gain, shift, _)| [gain.detach(), shift.detach()]),
            eps: eps.unwrap_or(0.0),
            bias: layer.bias.map(Tensor::detach),
        });
        maps.push(to);
        from = to;
    }
    let keep = inputs.iter().any(Tensor::track_op);
    let mut kept = Kept { direction, x: inputs[0].detach(), maps, layers: kept, pre: Vec::new() };
    let out = kept.forward(batch, keep)?;
    let shape = (batch, from.height, from.width, from.channels);
    Ok(Applied { inputs, out, shape, kept })
}

struct KeptLayer {
    weight: Tensor,
    norm: Option<[Tensor; 2]>,
    eps: f32,
    bias: Option<Tensor>,
}

impl KeptLayer {
    fn lock(&self, op: &'static str) -> Result<Locked<'_>> {
        let norm = match &self.norm {
            Some([gain, shift]) => Some([floats(op, gain)?, floats(op, shift)?]),
            None => None,
        };
        let bias = self.bias.as_ref().map(|bias| floats(op, bias)).transpose()?;
        Ok(Locked { weight: floats(op, &self.weight)?, norm, eps: self.eps, bias })
    }
}

/// What a stack's backward pass needs.
pub struct Kept {
    direction: Direction,
    x: Tensor,
    /// The input's map and every layer's.
    maps: Vec<Map>,
    layers: Vec<KeptLayer>,
    /// Every layer's output before its norm (none for a last layer without): [B, map].
    pre: Vec<Vec<f32>>,
}

/// A layer's parameters, locked for reading.
struct Locked<'a> {
    weight: Floats<'a>,
    norm: Option<[Floats<'a>; 2]>,
    eps: f32,
    bias: Option<Floats<'a>>,
}

impl Kept {
    fn lock(&self) -> Result<Vec<Locked<'_>>> {
        let op = self.direction.name();
        self.layers.iter().map(|layer| layer.lock(op)).collect()
    }

    fn pass<'a>(&self, locked: &'a [Locked<'_>], backward: bool) -> Pass<'a> {
        let layer = |(locked, maps): (&'a Locked<'_>, &[Map])| {
            let norm =
                locked.norm.as_ref().map(|[gain, shift]| Norm { gain, shift, eps: locked.eps, silu: true });
            Layer::new(
                self.direction,
                &locked.weight,
                norm,
                locked.bias.as_deref(),
                maps[0],
                maps[1],
                backward,
            )
        };
        Pass {
            arch: Arch::new(),
            direction: self.direction,
            layers: locked.iter().zip(self.maps.windows(2)).map(layer).collect(),
        }
    }

    fn shares(&self, batch: usize) -> Vec<Range<usize>> {
        parallel::shares(batch, SHARE_NUMBERS_MIN.div_ceil(self.maps[0].numbers()))
    }

    /// The last layer's output [B, map]; fills `pre` if asked to.
    fn forward(&mut self, batch: usize, keep: bool) -> Result<Vec<f32>> {
        let last = self.maps[self.maps.len() - 1].numbers();
        let mut out = vec![0.0; batch * last];
        let shares = self.shares(batch);
        // Without gradients to come, the space of one image per share is enough.
        let images = |share: &Range<usize>| if keep { share.len() } else { share.len().min(1) };
        let spaces: Vec<Range<usize>> = shares
            .iter()
            .scan(0, |from, share| {
                let start = *from;
                *from += images(share);
                Some(start..*from)
            })
            .collect();
        let total = spaces.last().map_or(0, |space| space.end);
        let normed = self.layers.iter().zip(&self.maps[1..]).filter(|(layer, _)| layer.norm.is_some());
        let mut pre: Vec<Vec<f32>> = normed.map(|(_, map)| vec![0.0; total * map.numbers()]).collect();
        {
            let locked = self.lock()?;
            let x = floats(self.direction.name(), &self.x)?;
            let pass = self.pass(&locked, false);
            let mut parts: Vec<Vec<&mut [f32]>> = shares.iter().map(|_| Vec::new()).collect();
            for (pre, map) in pre.iter_mut().zip(&self.maps[1..]) {
                let split = parallel::split(pre, &spaces, map.numbers());
                parts.iter_mut().zip(split).for_each(|(parts, part)| parts.push(part));
            }
            let outs = parallel::split(&mut out, &shares, last);
            let (pass, first) = (&pass, self.maps[0].numbers());
            let x = &*x;
            parallel::each(&shares, parts.into_iter().zip(outs), |share, (pre, out)| {
                pass.forward(&x[share.start * first..share.end * first], pre, keep, out);
            });
        }
        if keep {
            self.pre = pre;
        }
        Ok(out)
    }
}

impl Backward for Kept {
    fn name(&self) -> &'static str {
        self.direction.name()
    }

    fn backward(&self, grads: &[Option<Tensor>], wanted: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None; wanted.len()]) };
        if !wanted.contains(&true) {
            return Ok(vec![None; wanted.len()]);
        }
        let batch = self.x.dim(0)?;
        let shares = self.shares(batch);
        let first = self.maps[0].numbers();
        let mut dx = vec![0.0; if wanted[0] { batch * first } else { 0 }];
        let gradients = |_| Gradients::new(&self.maps, self.layers.iter().map(|layer| layer.norm.is_some()));
        let mut sums: Vec<Gradients> = shares.iter().map(gradients).collect();
        {
            let locked = self.lock()?;
            let (x, d_out) = (floats(self.name(), &self.x)?, floats(self.name(), grad)?);
            let pass = self.pass(&locked, true);
            let dx_width = if wanted[0] { first } else { 0 };
            let parts = parallel::split(&mut dx, &shares, dx_width).into_iter().zip(&mut sums);
            let (pass, x, d_out, pre) = (&pass, &*x, &*d_out, self.pre.as_slice());
            parallel::each(&shares, parts, |share, (dx, sums)| {
                let mut scratch = Scratch::new(&pass.layers);
                pass.backward(x, pre, d_out, share, dx, sums, &mut scratch);
            });
        }
        let mut sums = sums.into_iter();
        let Some(mut total) = sums.next() else { return Ok(vec![None; wanted.len()]) };
        sums.for_each(|sum| total.add(&sum));
        self.tensors(dx, total, wanted)
    }
}

impl Kept {
    /// Gradients in the order of the inputs.
    fn tensors(&self, dx: Vec<f32>, total: Gradients, wanted: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let mut found =
            vec![if wanted[0] { Some(Tensor::from_vec(dx, self.x.shape(), &Device::Cpu)?) } else { None }];
        let grads = total.weights.into_iter().zip(total.norms).zip(total.biases);
        for (layer, ((weight, norm), bias)) in self.layers.iter().zip(grads) {
            let (first, second, _, _) = layer.weight.dims4()?;
            let weight = match self.direction {
                Direction::Down => from_places(&weight, first, second, |place, out, input| {
                    (place * second + input) * first + out
                }),
                Direction::Up => from_places(&weight, first, second, |place, input, out| {
                    (place * second + out) * first + input
                }),
            };
            found.push(Some(Tensor::from_vec(weight, (first, second, 4, 4), &Device::Cpu)?));
            if layer.norm.is_some() {
                found.extend(super::norm::into_tensors(norm)?.map(Some));
            }
            if layer.bias.is_some() {
                let width = bias.len();
                found.push(Some(Tensor::from_vec(bias, width, &Device::Cpu)?));
            }
        }
        Ok(found)
    }
}

/// [first, second, 16] out of gradients whose entry for (place, first, second) is at `index`.
fn from_places(
    grads: &[f32],
    first: usize,
    second: usize,
    index: impl Fn(usize, usize, usize) -> usize,
) -> Vec<f32> {
    let mut out = Vec::with_capacity(grads.len());
    for a in 0..first {
        for b in 0..second {
            out.extend((0..16).map(|place| grads[index(place, a, b)]));
        }
    }
    out
}
