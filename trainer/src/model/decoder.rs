//! Latent state to image and mask.

use candle_core::{D, Result, Tensor};

use super::encoder::KERNEL_AREA;
use super::init::Init;
use super::layers::{Linear, NORM_EPS, Norm};
use super::parameters::{Built, Scope};
use crate::ops::{self, ConvLayer};

/// What one decoder reconstructs.
#[derive(Debug, Clone)]
pub struct Picture {
    /// [..., 64, 64, 3], in the range of `x/255 - 0.5`.
    pub image: Tensor,
    /// [..., 64, 64, 1], in (0, 1): how much of a pixel is this branch's.
    pub mask: Tensor,
}

impl Picture {
    /// The image times the mask: this branch's contribution to the whole picture.
    pub fn masked(&self) -> Result<Tensor> {
        self.image.broadcast_mul(&self.mask)
    }
}

/// A linear layer to 4x4 pixels of 8c channels and four transposed convolutions to 64x64: three image channels and a
/// mask logit.
#[derive(Debug, Clone)]
pub struct Decoder {
    linear: Linear,
    hidden: Vec<(Tensor, Norm)>,
    last: (Tensor, Tensor),
    channels: usize,
}

impl Decoder {
    /// `linear.*`, `0` to `2` `.conv.weight` and `.norm.*`, `3.conv.*`.
    pub fn new(scope: &Scope<'_>, state: usize, depth: usize) -> Built<Self> {
        let channels = 8 * depth;
        let linear = Linear::output(&scope.at("linear"), state, 16 * channels, 1.0)?;
        let mut hidden = Vec::with_capacity(3);
        for index in 0..3 {
            let (input, out) = (channels >> index, channels >> (index + 1));
            let init = Init::TruncatedNormal { fans: KERNEL_AREA * (input + out) };
            let scope = scope.at(index);
            let weight = scope.at("conv").get("weight", &[input, out, 4, 4], init)?;
            hidden.push((weight, Norm::new(&scope.at("norm"), out, NORM_EPS)?));
        }
        let init = Init::Uniform { fans: KERNEL_AREA * (depth + 4), scale: 1.0 };
        let last = scope.at(3).at("conv");
        let last = (last.get("weight", &[depth, 4, 4, 4], init)?, last.get("bias", &[4], Init::Zeros)?);
        Ok(Self { linear, hidden, last, channels })
    }

    /// `state` [..., n*m + d] to a picture.
    pub fn forward(&self, state: &Tensor) -> Result<Picture> {
        let x = self.raw(state)?;
        let image = x.narrow(D::Minus1, 0, 3)?;
        Ok(Picture { image, mask: ops::sigmoid(&x.narrow(D::Minus1, 3, 1)?)? })
    }

    /// `state` [..., n*m + d] to the three image channels and the mask's logit, [..., 64, 64, 4], as
    /// [`picture_loss`](ops::picture_loss) takes them.
    pub fn raw(&self, state: &Tensor) -> Result<Tensor> {
        let lead = &state.dims()[..state.rank() - 1];
        let x = ops::conv_up_stack(&self.first_map(state)?, &self.layers())?; // [N, 64, 64, 4]
        let shape = [lead, &x.dims()[1..]].concat();
        x.reshape(shape)
    }

    /// The map that the convolutions start from: `state` [..., n*m + d] to [N, 4, 4, 8c].
    pub fn first_map(&self, state: &Tensor) -> Result<Tensor> {
        self.linear.forward(state)?.reshape(((), 4, 4, self.channels))
    }

    /// The convolutions from there to [N, 64, 64, 4].
    #[must_use]
    pub fn layers(&self) -> Vec<ConvLayer<'_>> {
        let (weight, bias) = &self.last;
        let hidden = self.hidden.iter().map(|(weight, norm)| norm.after(weight));
        hidden.chain([ConvLayer { bias: Some(bias), ..ConvLayer::bare(weight) }]).collect()
    }
}
