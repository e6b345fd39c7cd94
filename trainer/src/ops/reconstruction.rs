use candle_core::{DType, Device, Result, Tensor};

use super::conv_pass::Direction;
use super::conv_stack::{self, ConvLayer};
use super::node::{Backward, fusible, record};
use super::{conv_up_stack, picture, picture_loss};

/// [`picture_loss`] of what the decoders' stacks decode: `conv_up_stack` of each (input, layers), the robot's first. A stack makes
/// [N, H, W, 4 C]; of several cameras those of a pixel are taken for pixels side by side: `image` is [N, H, W * C, 3], `mask` [N, H, W * C].
///
/// As one op, because the pictures are by far the largest tensors of an update: nothing of their size, nor of their gradients', passes
/// through candle. Cost: that of the parts.
pub fn reconstruction_loss(
    stacks: &[(&Tensor, &[ConvLayer<'_>])],
    image: &Tensor,
    mask: Option<&Tensor>,
) -> Result<(Tensor, Option<Tensor>)> {
    let fused =
        |(x, layers): &(&Tensor, &[ConvLayer<'_>])| layers.iter().all(|layer| fusible(&[x, layer.weight]));
    if !stacks.iter().all(fused) || image.dtype() != DType::U8 {
        let raw = |(x, layers): &(&Tensor, &[ConvLayer<'_>])| side_by_side(conv_up_stack(x, layers)?);
        let raws = stacks.iter().map(raw).collect::<Result<Vec<_>>>()?;
        return picture_loss(&raws.iter().collect::<Vec<_>>(), image, mask);
    }
    let (mut inputs, mut raws, mut decoders) = (Vec::new(), Vec::new(), Vec::new());
    for (x, layers) in stacks {
        let applied = conv_stack::apply(Direction::Up, x, layers)?;
        decoders.push((applied.kept, applied.inputs.len()));
        inputs.extend(applied.inputs);
        raws.push(side_by_side(Tensor::from_vec(applied.out, applied.shape, &Device::Cpu)?)?);
    }
    let (outputs, loss) = picture::apply(&raws.iter().collect::<Vec<_>>(), image, mask)?;
    picture::losses(record(&inputs.iter().collect::<Vec<_>>(), outputs, Kept { decoders, loss })?)
}

/// [N, H, W, 4 C] as [N, H, W * C, 4].
fn side_by_side(raw: Tensor) -> Result<Tensor> {
    let (n, height, width, channels) = raw.dims4()?;
    raw.reshape((n, height, width * channels / 4, 4))
}

struct Kept {
    /// Each stack with the number of its inputs.
    decoders: Vec<(conv_stack::Kept, usize)>,
    loss: picture::Kept,
}

impl Backward for Kept {
    fn name(&self) -> &'static str {
        "reconstruction-loss"
    }

    fn backward(&self, grads: &[Option<Tensor>], wanted: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let raws = self.loss.backward(grads, &vec![true; self.decoders.len()])?;
        let mut found = Vec::with_capacity(wanted.len());
        let mut rest = wanted;
        for ((decoder, inputs), grad) in self.decoders.iter().zip(raws) {
            let (wanted, later) = rest.split_at(*inputs);
            found.extend(decoder.backward(&[grad], wanted)?);
            rest = later;
        }
        Ok(found)
    }
}
