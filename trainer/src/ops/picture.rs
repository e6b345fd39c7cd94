use candle_core::{CpuStorage, DType, Device, Error, Result, Shape, Storage, Tensor};

use super::composite;
use super::node::{Backward, floats, fusible, mismatch, record};
use super::parallel;
use rcwm_kernels::batch::picture::{self, Masks, RAW, Target};

/// `x/255 - 0.5` of a u8 image, as f32; channels last. 5 bytes a number.
pub fn image_to_float(image: &Tensor) -> Result<Tensor> {
    if !matches!(image.device(), Device::Cpu) || image.dtype() != DType::U8 {
        return composite::image_to_float(image);
    }
    let bytes = bytes("image-to-float", &image.contiguous()?)?;
    let levels = picture::levels();
    let mut out = vec![0.0; bytes.len()];
    let shares = parallel::shares(bytes.len(), 1 << 16);
    parallel::each(&shares, parallel::split(&mut out, &shares, 1), |share, out| {
        for (out, byte) in out.iter_mut().zip(&bytes[share]) {
            *out = levels[usize::from(*byte)];
        }
    });
    Tensor::from_vec(out, image.shape(), image.device())
}

/// A copy of the numbers of a contiguous u8 tensor on the CPU.
fn bytes(op: &'static str, x: &Tensor) -> Result<Vec<u8>> {
    let (storage, layout) = x.storage_and_layout();
    let Some((from, to)) = layout.contiguous_offsets() else {
        return Err(Error::RequiresContiguous { op }.bt());
    };
    match &*storage {
        Storage::Cpu(CpuStorage::U8(bytes)) => Ok(bytes[from..to].to_vec()),
        _ => candle_core::bail!("{op}: expected u8 on the CPU, found {:?}", x.dtype()),
    }
}

/// Squared errors of each picture: `sum (o_hat - o)^2` [N] over pixels and channels, and `sum (m_hat - m)^2` [N] of the robot's mask if one is given
/// (eq. 8, 9).
///
/// `raws` are decoder outputs [N, H, W, 4], the robot's first: three image channels and a mask logit. Of two, the picture is
/// `o_R m_R + o_E m_E`; of one (the vanilla baseline), its image alone. `image` is u8 [N, H, W, 3], `mask` [N, H, W] of 0 and 1.
///
/// Cost a pixel: 60 flops and 40 bytes forward, 90 flops and 72 bytes backward.
pub fn picture_loss(
    raws: &[&Tensor],
    image: &Tensor,
    mask: Option<&Tensor>,
) -> Result<(Tensor, Option<Tensor>)> {
    if !fusible(raws) || image.dtype() != DType::U8 {
        return composite::picture_loss(raws, image, mask);
    }
    let raws = raws.iter().map(|raw| raw.contiguous()).collect::<Result<Vec<_>>>()?;
    let (outputs, kept) = apply(&raws.iter().collect::<Vec<_>>(), image, mask)?;
    losses(record(&raws.iter().collect::<Vec<_>>(), outputs, kept)?)
}

/// The loss, and the mask's where there is one.
pub(super) fn losses(outputs: Vec<Tensor>) -> Result<(Tensor, Option<Tensor>)> {
    let mut outputs = outputs.into_iter();
    let Some(loss) = outputs.next() else { candle_core::bail!("{OP}: no output") };
    Ok((loss, outputs.next()))
}

/// Losses outside candle's graph.
pub(super) type Outputs = Vec<(Vec<f32>, Shape)>;

/// Computes the losses without putting them into candle's graph; `raws` must be contiguous.
pub(super) fn apply(raws: &[&Tensor], image: &Tensor, mask: Option<&Tensor>) -> Result<(Outputs, Kept)> {
    let (&[first] | &[first, _]) = raws else {
        candle_core::bail!("{OP}: {} pictures, expected one or two", raws.len());
    };
    let (n, height, width, channels) = first.dims4()?;
    if let Some(wrong) = raws.iter().find(|raw| raw.dims() != first.dims() || channels != RAW) {
        return mismatch(OP, first, wrong);
    }
    if image.dims() != [n, height, width, 3] {
        return mismatch(OP, first, image);
    }
    if let Some(mask) = mask.filter(|mask| mask.dims() != [n, height, width]) {
        return mismatch(OP, first, mask);
    }
    let mask = match mask {
        Some(mask) => Some(floats(OP, &mask.to_dtype(DType::F32)?.contiguous()?)?.to_vec()),
        None => None,
    };
    let kept = Kept {
        raws: raws.iter().map(|raw| raw.detach()).collect(),
        image: bytes(OP, &image.contiguous()?)?,
        mask,
        pixels: height * width,
    };
    let (losses, mask_losses) = kept.forward(n)?;
    let mut outputs = vec![(losses, n.into())];
    outputs.extend(kept.mask.is_some().then(|| (mask_losses, n.into())));
    Ok((outputs, kept))
}

const OP: &str = "picture-loss";

pub(super) struct Kept {
    raws: Vec<Tensor>,
    image: Vec<u8>,
    mask: Option<Vec<f32>>,
    pixels: usize,
}

impl Kept {
    fn target(&self, index: usize) -> Target<'_> {
        let pixels = self.pixels;
        Target {
            image: &self.image[index * pixels * 3..][..pixels * 3],
            mask: self.mask.as_ref().map(|mask| &mask[index * pixels..][..pixels]),
        }
    }

    fn forward(&self, n: usize) -> Result<(Vec<f32>, Vec<f32>)> {
        let raws = self.raws.iter().map(|raw| floats(OP, raw)).collect::<Result<Vec<_>>>()?;
        let raws: Vec<&[f32]> = raws.iter().map(|raw| &**raw).collect();
        let (mut losses, mut mask_losses) = (vec![0.0; n], vec![0.0; n]);
        let shares = parallel::shares(n, 1);
        let size = self.pixels * RAW;
        let raws = &raws;
        let parts = parallel::split(&mut losses, &shares, 1).into_iter();
        let parts = parts.zip(parallel::split(&mut mask_losses, &shares, 1));
        parallel::each(&shares, parts, |share, (losses, mask_losses)| {
            let mut masks = Masks::new(self.pixels);
            for (index, (loss, mask_loss)) in share.zip(losses.iter_mut().zip(mask_losses)) {
                let raws: Vec<&[f32]> = raws.iter().map(|raw| &raw[index * size..][..size]).collect();
                (*loss, *mask_loss) = picture::loss(&raws, self.target(index), &mut masks);
            }
        });
        Ok((losses, mask_losses))
    }
}

impl Backward for Kept {
    fn name(&self) -> &'static str {
        OP
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let n = self.raws[0].dim(0)?;
        let scales = |index: usize| match grads.get(index).and_then(Option::as_ref) {
            Some(grad) => floats(OP, grad).map(|grad| grad.to_vec()),
            None => Ok(vec![0.0; n]),
        };
        let (scales, mask_scales) = (scales(0)?, scales(1)?);
        let raws = self.raws.iter().map(|raw| floats(OP, raw)).collect::<Result<Vec<_>>>()?;
        let raws: Vec<&[f32]> = raws.iter().map(|raw| &**raw).collect();
        let size = self.pixels * RAW;
        let mut found: Vec<Vec<f32>> = raws.iter().map(|raw| vec![0.0; raw.len()]).collect();
        let shares = parallel::shares(n, 1);
        let mut parts: Vec<Vec<&mut [f32]>> = shares.iter().map(|_| Vec::new()).collect();
        for grads in &mut found {
            parts
                .iter_mut()
                .zip(parallel::split(grads, &shares, size))
                .for_each(|(parts, part)| parts.push(part));
        }
        let (raws, scales, mask_scales) = (&raws, &scales, &mask_scales);
        parallel::each(&shares, parts, |share, mut grads| {
            let mut masks = Masks::new(self.pixels);
            for (place, index) in share.enumerate() {
                let raws: Vec<&[f32]> = raws.iter().map(|raw| &raw[index * size..][..size]).collect();
                let mut grads: Vec<&mut [f32]> =
                    grads.iter_mut().map(|grads| &mut grads[place * size..][..size]).collect();
                let scales = (scales[index], mask_scales[index]);
                picture::loss_backward(&raws, self.target(index), &mut masks, scales, &mut grads);
            }
        });
        let tensor = |grad| Tensor::from_vec(grad, self.raws[0].shape(), &Device::Cpu).map(Some);
        found.into_iter().map(tensor).collect()
    }
}
