//! Latent state to image and mask.

use candle_core::{D, Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::encoder::KERNEL_AREA;
use super::init::Init;
use super::layers::{Linear, NORM_EPS, Norm};
use super::parameters::{Built, Scope};
use crate::ops::{self, ConvLayer};

/// Channels that a decoder makes of a pixel of one camera.
pub const RAW: usize = 4;

/// Channels of a decoder's maps from 4 x 4 pixels on, before the last convolution: 8c, 4c, 2c, c, and 8c once more for images of 128,
/// so that maps of one size have as many channels as the encoder's.
pub fn decoder_channels(settings: &ModelSettings) -> Vec<usize> {
    let mut channels = vec![8 * settings.cnn_depth; settings.stages() - 4];
    channels.extend((0..4).map(|step| (8 * settings.cnn_depth) >> step));
    channels
}

/// What one decoder reconstructs.
#[derive(Debug, Clone)]
pub struct Picture {
    /// [..., S, S, 3 C], in the range of `x/255 - 0.5`.
    pub image: Tensor,
    /// [..., S, S, C], in (0, 1): how much of a pixel is this branch's, one number a camera.
    pub mask: Tensor,
}

impl Picture {
    /// The image times the mask: this branch's contribution to the whole picture.
    pub fn masked(&self) -> Result<Tensor> {
        let (image, mask) = (pixels(&self.image, 3)?, pixels(&self.mask, 1)?);
        image.broadcast_mul(&mask)?.reshape(self.image.shape())
    }
}

/// Channels [..., S, S, each * C] with the cameras of a pixel as pixels side by side: [..., S, S * C, each].
pub fn pixels(x: &Tensor, each: usize) -> Result<Tensor> {
    let [lead @ .., columns, channels] = x.dims() else { candle_core::bail!("no picture: {:?}", x.dims()) };
    x.reshape([lead, &[columns * channels / each, each]].concat())
}

/// A linear layer to 4x4 pixels of 8c channels and transposed convolutions to SxS, four for 64 and five for 128: three image channels and
/// a mask logit for each camera.
#[derive(Debug, Clone)]
pub struct Decoder {
    linear: Linear,
    hidden: Vec<(Tensor, Norm)>,
    last: (Tensor, Tensor),
    channels: usize,
}

impl Decoder {
    /// `linear.*`, `0` to `2` `.conv.weight` and `.norm.*`, `3.conv.*`; for images of 128 one more.
    pub fn new(scope: &Scope<'_>, settings: &ModelSettings) -> Built<Self> {
        let (depth, out) = (settings.cnn_depth, RAW * settings.cameras);
        let channels = 8 * depth;
        let linear = Linear::output(&scope.at("linear"), settings.branch_width(), 16 * channels, 1.0)?;
        let steps = decoder_channels(settings);
        let mut hidden = Vec::with_capacity(steps.len() - 1);
        for (index, step) in steps.windows(2).enumerate() {
            let (input, out) = (step[0], step[1]);
            let init = Init::TruncatedNormal { fans: KERNEL_AREA * (input + out) };
            let scope = scope.at(index);
            let weight = scope.at("conv").get("weight", &[input, out, 4, 4], init)?;
            hidden.push((weight, Norm::new(&scope.at("norm"), out, NORM_EPS)?));
        }
        let init = Init::Uniform { fans: KERNEL_AREA * (depth + out), scale: 1.0 };
        let last = scope.at(steps.len() - 1).at("conv");
        let last = (last.get("weight", &[depth, out, 4, 4], init)?, last.get("bias", &[out], Init::Zeros)?);
        Ok(Self { linear, hidden, last, channels })
    }

    /// `state` [..., n*m + d] to a picture.
    pub fn forward(&self, state: &Tensor) -> Result<Picture> {
        let raw = self.raw(state)?; // [..., S, S, 4 C]
        let [lead @ .., side, channels] = raw.dims() else {
            candle_core::bail!("no picture: {:?}", raw.dims())
        };
        let cameras = channels / RAW;
        let x = pixels(&raw, RAW)?; // [..., S, S * C, 4]
        let of = |x: Tensor, each: usize| x.reshape([lead, &[*side, each * cameras]].concat());
        let image = of(x.narrow(D::Minus1, 0, 3)?, 3)?;
        Ok(Picture { image, mask: of(ops::sigmoid(&x.narrow(D::Minus1, 3, 1)?)?, 1)? })
    }

    /// `state` [..., n*m + d] to three image channels and the mask's logit of every camera, [..., S, S, 4 C].
    pub fn raw(&self, state: &Tensor) -> Result<Tensor> {
        let lead = &state.dims()[..state.rank() - 1];
        let x = ops::conv_up_stack(&self.first_map(state)?, &self.layers())?; // [N, S, S, 4 C]
        let shape = [lead, &x.dims()[1..]].concat();
        x.reshape(shape)
    }

    /// The map that the convolutions start from: `state` [..., n*m + d] to [N, 4, 4, 8c].
    pub fn first_map(&self, state: &Tensor) -> Result<Tensor> {
        self.linear.forward(state)?.reshape(((), 4, 4, self.channels))
    }

    /// The convolutions from there to [N, S, S, 4 C].
    #[must_use]
    pub fn layers(&self) -> Vec<ConvLayer<'_>> {
        let (weight, bias) = &self.last;
        let hidden = self.hidden.iter().map(|(weight, norm)| norm.after(weight));
        hidden.chain([ConvLayer { bias: Some(bias), ..ConvLayer::bare(weight) }]).collect()
    }
}
