//! Images to features to embeddings.

use candle_core::{Result, Tensor};
use rcwm_models::settings::ModelSettings;

use super::init::Init;
use super::layers::{NORM_EPS, Norm};
use super::parameters::{Built, Scope};
use crate::ops;

/// Kernel area of every convolution.
pub(super) const KERNEL_AREA: usize = 16;

pub use crate::ops::image_to_float;

/// Convolutions that halve the sides, each with LayerNorm over channels and `SiLU`.
#[derive(Debug, Clone)]
pub struct ConvStack {
    layers: Vec<(Tensor, Norm)>,
}

/// Channels of the branches' own convolutions, from the shared features' 2c down to 4 x 4 pixels: one step more for images of 128.
pub fn branch_channels(settings: &ModelSettings) -> Vec<usize> {
    let c = settings.cnn_depth;
    let mut channels = vec![4 * c; settings.stages() - 1];
    channels[0] = 2 * c;
    channels
}

impl ConvStack {
    /// One layer for each step of `channels`: `i.conv.weight`, `i.norm.*`.
    pub fn new(scope: &Scope<'_>, channels: &[usize]) -> Built<Self> {
        let layer = |(index, step): (usize, &[usize])| {
            let (input, out) = (step[0], step[1]);
            let init = Init::TruncatedNormal { fans: KERNEL_AREA * (input + out) };
            let scope = scope.at(index);
            let weight = scope.at("conv").get("weight", &[out, input, 4, 4], init)?;
            Ok((weight, Norm::new(&scope.at("norm"), out, NORM_EPS)?))
        };
        Ok(Self { layers: channels.windows(2).enumerate().map(layer).collect::<Built<_>>()? })
    }

    /// `x` [N, H, W, first channels] to [N, H/2^layers, W/2^layers, last channels].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let layers: Vec<_> = self.layers.iter().map(|(weight, norm)| norm.after(weight)).collect();
        ops::conv_down_stack(x, &layers)
    }
}

/// Flattens [N, 4, 4, C] in (channel, row, column) order, as the posterior's weights expect it: [N, 16 C].
pub fn flatten_channels_first(x: &Tensor) -> Result<Tensor> {
    x.permute((0, 3, 1, 2))?.flatten_from(1)
}
