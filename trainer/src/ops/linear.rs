use candle_core::{D, Result, Tensor};

use super::composite;
use super::gemm::{Matrix, product};
use super::node::{Backward, Floats, floats, fusible, mismatch, record_one, row_strided};
use rcwm_kernels::batch::norm::add_rows;

/// `x W^T + b` over the last dimension: `x` [..., in], `weight` [out, in], `bias` [out], gives [..., out].
///
/// Cost: `2 rows in out` flops forward, twice that backward; the weights are read where they lie, also as a slice of the columns of a
/// larger matrix.
pub fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    if fusible(&[x, weight, bias.unwrap_or(weight)]) {
        fused(x, weight, bias)
    } else {
        composite::linear(x, weight, bias)
    }
}

const OP: &str = "linear";

fn fused(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let (out, width) = weight.dims2()?;
    if x.dim(D::Minus1)? != width || width == 0 {
        return mismatch(OP, x, weight);
    }
    if let Some(bias) = bias.filter(|bias| bias.dims() != [out]) {
        return mismatch(OP, weight, bias);
    }
    let x = x.contiguous()?;
    let weight = if row_strided(OP, weight)?.is_some() { weight.clone() } else { weight.contiguous()? };
    let rows = x.elem_count() / width;
    let mut values = Vec::new();
    match bias {
        None => values.resize(rows * out, 0.0),
        Some(bias) => {
            let bias = floats(OP, bias)?;
            values.reserve_exact(rows * out);
            (0..rows).for_each(|_| values.extend_from_slice(&bias));
        }
    }
    {
        let (w, stride) = weight_view(&weight)?;
        let w = Matrix::strided(&w, out, width, stride);
        product(Matrix::new(&floats(OP, &x)?, rows, width), w.t(), &mut values, out, bias.is_some());
    }
    let shape = [&x.dims()[..x.rank() - 1], &[out]].concat();
    let kept = Kept { x: x.detach(), weight: weight.detach() };
    match bias {
        Some(bias) => record_one(&[&x, &weight, bias], values, shape, kept),
        None => record_one(&[&x, &weight], values, shape, kept),
    }
}

fn weight_view(weight: &Tensor) -> Result<(Floats<'_>, usize)> {
    match row_strided(OP, weight)? {
        Some(view) => Ok(view),
        None => Err(candle_core::Error::RequiresContiguous { op: OP }.bt()),
    }
}

struct Kept {
    x: Tensor,
    weight: Tensor,
}

impl Backward for Kept {
    fn name(&self) -> &'static str {
        OP
    }

    fn backward(&self, grads: &[Option<Tensor>], wanted: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None; wanted.len()]) };
        let (out, width) = self.weight.dims2()?;
        let rows = self.x.elem_count() / width;
        let dy = floats(OP, grad)?;
        let d_out = Matrix::new(&dy, rows, out);
        let device = self.x.device();
        let mut found = vec![None; wanted.len()];
        if wanted[0] {
            let (w, stride) = weight_view(&self.weight)?;
            let mut dx = vec![0.0; rows * width];
            product(d_out, Matrix::strided(&w, out, width, stride), &mut dx, width, false);
            found[0] = Some(Tensor::from_vec(dx, self.x.shape(), device)?);
        }
        if wanted[1] {
            let x = floats(OP, &self.x)?;
            let mut dw = vec![0.0; out * width];
            product(d_out.t(), Matrix::new(&x, rows, width), &mut dw, width, false);
            found[1] = Some(Tensor::from_vec(dw, (out, width), device)?);
        }
        if wanted.get(2) == Some(&true) {
            let mut sum = vec![0.0; out];
            add_rows(&mut sum, &dy);
            found[2] = Some(Tensor::from_vec(sum, out, device)?);
        }
        Ok(found)
    }
}
