//! Convolutions of kernel 4, stride 2, padding 1, as windows and one matrix product.
//!
//! With a stride of half the kernel, a 4x4 window is a 2x2 window of 2x2 blocks, and each of the four outputs that a
//! transposed convolution makes per input pixel sees a 2x2 window of the input: both need only reshapes and slices.

use candle_core::{D, Result, Tensor};

/// Halves the sides of a feature map: `x` [B, H, W, C], `weight` [out, C, 4, 4], gives [B, H/2, W/2, out].
///
/// # Errors
/// Those of candle (shapes, devices); H and W must be even.
pub fn conv_down(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let (batch, height, width, channels) = x.dims4()?;
    let out = weight.dim(0)?;
    let (rows, columns) = (height / 2, width / 2);
    let blocks = x
        .pad_with_zeros(1, 1, 1)?
        .pad_with_zeros(2, 1, 1)?
        .reshape(&[batch, rows + 1, 2, columns + 1, 2, channels])?
        .permute([0, 1, 3, 2, 4, 5].as_slice())?
        .reshape((batch, rows + 1, columns + 1, 4 * channels))?;
    let windows = windows_2x2(&blocks, rows, columns)?; // [B, H/2, W/2, 16C], as (i, j, a, b, c): row 2i+a, column 2j+b
    let kernel = weight
        .reshape(&[out, channels, 2, 2, 2, 2])? // (out, c, i, a, j, b)
        .permute([2, 4, 3, 5, 1, 0].as_slice())?
        .reshape((16 * channels, out))?;
    windows
        .reshape((batch * rows * columns, 16 * channels))?
        .matmul(&kernel)?
        .reshape((batch, rows, columns, out))
}

/// Doubles the sides of a feature map (transposed convolution): `x` [B, H, W, C], `weight` [C, out, 4, 4], gives
/// [B, 2H, 2W, out].
pub fn conv_up(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let (batch, height, width, channels) = x.dims4()?;
    let out = weight.dim(1)?;
    let padded = x.pad_with_zeros(1, 1, 1)?.pad_with_zeros(2, 1, 1)?;
    let windows = windows_2x2(&padded, height + 1, width + 1)?; // [B, H+1, W+1, 4C], as (i, j, c)
    // Output row 2p + a takes kernel row 3 - a - 2i from input row p + a + i - 1.
    let kernels = weight
        .flip(&[2, 3])?
        .reshape(&[channels, out, 2, 2, 2, 2])? // (c, out, i, a, j, b)
        .permute([3, 5, 2, 4, 0, 1].as_slice())?
        .reshape((4, 4 * channels, out))?;
    let mut phases = Vec::with_capacity(4);
    for (phase, (a, b)) in [(0, 0), (0, 1), (1, 0), (1, 1)].into_iter().enumerate() {
        let seen = windows.narrow(1, a, height)?.narrow(2, b, width)?;
        let seen = seen.reshape((batch * height * width, 4 * channels))?;
        phases.push(seen.matmul(&kernels.get(phase)?)?);
    }
    Tensor::cat(&phases, 1)? // [B*H*W, (a, b, out)]
        .reshape(&[batch, height, width, 2, 2, out])?
        .permute([0, 1, 3, 2, 4, 5].as_slice())?
        .reshape((batch, 2 * height, 2 * width, out))
}

/// The 2x2 windows at `rows` x `columns` places, `[B, rows, columns, 4C]` as (i, j, c).
fn windows_2x2(x: &Tensor, rows: usize, columns: usize) -> Result<Tensor> {
    let corner = |i: usize, j: usize| x.narrow(1, i, rows)?.narrow(2, j, columns);
    Tensor::cat(&[corner(0, 0)?, corner(0, 1)?, corner(1, 0)?, corner(1, 1)?], D::Minus1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn ramp(shape: &[usize]) -> Var {
        let count: usize = shape.iter().product();
        let values: Vec<f32> = (0..count).map(|i| ((i * 37 % 101) as f32 / 50.0) - 1.0).collect();
        Var::from_tensor(&Tensor::from_vec(values, shape, &Device::Cpu).unwrap()).unwrap()
    }

    fn assert_close(a: &Tensor, b: &Tensor) {
        let error = (a - b).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        assert!(error.to_scalar::<f32>().unwrap() < 1e-4, "{error}");
    }

    /// Compares values and both gradients of `ours` on channels-last maps with candle's own channels-first convolution.
    fn compare(
        x: &Var,
        weight: &Var,
        ours: fn(&Tensor, &Tensor) -> Result<Tensor>,
        theirs: impl Fn(&Tensor, &Tensor) -> Tensor,
    ) {
        let channels_first = x.permute((0, 3, 1, 2)).unwrap().contiguous().unwrap();
        let expected = theirs(&channels_first, weight).permute((0, 2, 3, 1)).unwrap();
        let found = ours(x, weight).unwrap();
        assert_close(&found, &expected);
        let scores = ramp(found.dims());
        let grads = |y: Tensor| (y * scores.as_tensor()).unwrap().sum_all().unwrap().backward().unwrap();
        let (found, expected) = (grads(found), grads(expected));
        for var in [x, weight] {
            assert_close(found.get(var).unwrap(), expected.get(var).unwrap());
        }
    }

    #[test]
    fn halving_equals_the_plain_convolution_forward_and_backward() {
        let (x, weight) = (ramp(&[2, 8, 6, 3]), ramp(&[5, 3, 4, 4]));
        compare(&x, &weight, conv_down, |x, weight| x.conv2d(weight, 1, 2, 1, 1).unwrap());
    }

    #[test]
    fn doubling_equals_the_plain_transposed_convolution_forward_and_backward() {
        let (x, weight) = (ramp(&[2, 4, 3, 3]), ramp(&[3, 5, 4, 4]));
        compare(&x, &weight, conv_up, |x, weight| x.conv_transpose2d(weight, 1, 0, 2, 1).unwrap());
    }
}
