use candle_core::{D, DType, Result, Tensor};

use super::sigmoid;

/// See [`crate::ops::image_to_float`].
pub fn image_to_float(image: &Tensor) -> Result<Tensor> {
    // A division, not a product with the inverse: the last bit then agrees with other implementations.
    let full = Tensor::new(255f32, image.device())?;
    image.to_dtype(DType::F32)?.broadcast_div(&full)? - 0.5
}

/// The reconstructed image [..., 3] and its mask [..., 1] of raw decoder outputs [..., 4].
pub fn reconstruction(raw: &Tensor) -> Result<(Tensor, Tensor)> {
    Ok((raw.narrow(D::Minus1, 0, 3)?, sigmoid(&raw.narrow(D::Minus1, 3, 1)?)?))
}

/// See [`crate::ops::picture_loss`].
pub fn picture_loss(
    raws: &[&Tensor],
    image: &Tensor,
    mask: Option<&Tensor>,
) -> Result<(Tensor, Option<Tensor>)> {
    let image = image_to_float(image)?;
    let pictures = raws.iter().map(|raw| reconstruction(raw)).collect::<Result<Vec<_>>>()?;
    let whole = match pictures.as_slice() {
        [(picture, _)] => picture.clone(),
        [(robot, robot_mask), (environment, environment_mask)] => {
            (robot.broadcast_mul(robot_mask)? + environment.broadcast_mul(environment_mask)?)?
        }
        _ => candle_core::bail!("picture-loss: {} pictures, expected one or two", pictures.len()),
    };
    let squares = |error: Tensor| error.sqr()?.flatten_from(1)?.sum(D::Minus1);
    let loss = squares((whole - image)?)?;
    let mask_loss = mask.map(|mask| {
        let mask = mask.to_dtype(DType::F32)?.unsqueeze(D::Minus1)?;
        squares((&pictures[0].1 - mask)?)
    });
    Ok((loss, mask_loss.transpose()?))
}
