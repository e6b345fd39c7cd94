use candle_core::{D, Result, Tensor};

/// `x W^T + b` over the last dimension: `x` [..., in], `weight` [out, in], `bias` [out], gives [..., out].
pub fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let (out, width) = weight.dims2()?;
    let mut shape = x.dims().to_vec();
    let rows = x.elem_count() / x.dim(D::Minus1)?.max(1);
    // A GPU multiplies whole matrices only, no slices of the columns of a larger one.
    let y = x.reshape((rows, width))?.matmul(&weight.contiguous()?.t()?)?;
    let y = match bias {
        Some(bias) => y.broadcast_add(bias)?,
        None => y,
    };
    if let Some(last) = shape.last_mut() {
        *last = out;
    }
    y.reshape(shape)
}
