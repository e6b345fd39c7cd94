//! Ops that turn every row of one tensor into a row or a number, independently of the others.

use std::ops::Range;

use candle_core::{D, Result, Shape, Tensor};

use super::node::{Backward, floats, record_one};
use super::parallel;

/// Numbers below which a second thread costs more than it gives.
const SHARE_NUMBERS_MIN: usize = 16_384;

/// What is done with each row of `width` numbers of the input.
pub(super) trait RowOp: Send + Sync {
    /// Name in error messages.
    const NAME: &'static str;

    /// Numbers of the output per row of the input.
    fn out_width(&self, width: usize) -> usize;

    /// Makes the output rows of these input rows; `rows` tells which they are.
    fn forward(&self, x: &[f32], width: usize, rows: Range<usize>, out: &mut [f32]);

    /// Gradient of these input rows.
    fn backward(&self, x: &[f32], width: usize, rows: Range<usize>, d_out: &[f32], dx: &mut [f32]);
}

/// Applies a row op; `shape` is the output's.
pub(super) fn apply<R: RowOp + 'static>(x: &Tensor, shape: impl Into<Shape>, op: R) -> Result<Tensor> {
    let width = x.dim(D::Minus1)?;
    if width == 0 {
        candle_core::bail!("{}: rows of no numbers in {:?}", R::NAME, x.shape());
    }
    let x = x.contiguous()?;
    let out_width = op.out_width(width);
    let rows = x.elem_count() / width;
    let mut out = vec![0.0; rows * out_width];
    {
        let x = floats(R::NAME, &x)?;
        let (x, op) = (&*x, &op);
        let shares = parallel::shares(rows, SHARE_NUMBERS_MIN / width);
        let parts = parallel::split(&mut out, &shares, out_width);
        parallel::each(&shares, parts, |share, out| {
            op.forward(&x[share.start * width..share.end * width], width, share, out);
        });
    }
    let kept = Kept { op, x: x.detach() };
    record_one(&[&x], out, shape, kept)
}

struct Kept<R> {
    op: R,
    x: Tensor,
}

impl<R: RowOp> Backward for Kept<R> {
    fn name(&self) -> &'static str {
        R::NAME
    }

    fn backward(&self, grads: &[Option<Tensor>], _: &[bool]) -> Result<Vec<Option<Tensor>>> {
        let [Some(grad)] = grads else { return Ok(vec![None]) };
        let width = self.x.dim(D::Minus1)?;
        let out_width = self.op.out_width(width);
        let (x, d_out) = (floats(R::NAME, &self.x)?, floats(R::NAME, grad)?);
        let mut dx = vec![0.0; x.len()];
        let shares = parallel::shares(x.len() / width, SHARE_NUMBERS_MIN / width);
        let (x, d_out, op) = (&*x, &*d_out, &self.op);
        let parts = parallel::split(&mut dx, &shares, width);
        parallel::each(&shares, parts, |share, dx| {
            let x = &x[share.start * width..share.end * width];
            let d_out = &d_out[share.start * out_width..share.end * out_width];
            op.backward(x, width, share, d_out, dx);
        });
        Ok(vec![Some(Tensor::from_vec(dx, self.x.shape(), self.x.device())?)])
    }
}
