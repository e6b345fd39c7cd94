//! One step of Adam on one variable, and the norm that gradients are clipped by.

use std::sync::Mutex;

use candle_core::{CpuStorage, InplaceOp1, Layout, Result, Tensor, Var};

use super::node::{floats, fusible, mismatch};
use super::parallel;
use rcwm_kernels::vectorised;

/// One step as in PyTorch: bias correction, epsilon outside the square root.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamStep {
    /// Which step of this variable it is: 1 is the first.
    pub number: u64,
    /// What the gradient is multiplied with first.
    pub scale: f64,
    /// Step size.
    pub rate: f64,
    /// Decay of the mean of gradients.
    pub beta1: f64,
    /// Decay of the mean of squares.
    pub beta2: f64,
    /// Added to the square root of the mean of squares.
    pub eps: f64,
}

/// Moves `var` and its moments by one step, in place: `var -= rate * m / (1 - b1^t) / (sqrt(v / (1 - b2^t)) + eps)`.
///
/// Cost a number: 28 bytes and 15 flops.
pub fn adam_step(var: &Var, mean: &Var, square: &Var, grad: &Tensor, step: &AdamStep) -> Result<()> {
    let kernel = Kernel::new(step);
    if fusible(&[var, mean, square, grad]) {
        kernel.fused([var, mean, square], &grad.contiguous()?)
    } else {
        kernel.composite([var, mean, square], grad)
    }
}

/// Sum of squares of all numbers of a tensor, in f64. Cost a number: 2 flops and 4 bytes.
pub fn sum_of_squares(x: &Tensor) -> Result<f64> {
    if fusible(&[x]) {
        let x = x.contiguous()?;
        Ok(squares(&floats(OP, &x)?))
    } else {
        Ok(f64::from(x.sqr()?.sum_all()?.to_scalar::<f32>()?))
    }
}

const OP: &str = "adam";

/// Sum of squares: f32 lanes over short runs, f64 over the runs.
fn squares(grad: &[f32]) -> f64 {
    vectorised(
        #[inline(always)]
        || {
            let mut total = 0.0;
            for run in grad.chunks(2048) {
                total += f64::from(rcwm_kernels::batch::math::sum_of(
                    run,
                    #[inline(always)]
                    |x| x * x,
                ));
            }
            total
        },
    )
}

/// The numbers of one step.
#[derive(Debug, Clone, Copy)]
struct Kernel {
    scale: f32,
    beta1: f32,
    beta2: f32,
    keep1: f32,
    keep2: f32,
    rate: f32,
    root: f32,
    eps: f32,
}

impl Kernel {
    fn new(step: &AdamStep) -> Self {
        let AdamStep { number, scale, rate, beta1, beta2, eps } = *step;
        let number = number as f64;
        Self {
            scale: scale as f32,
            beta1: beta1 as f32,
            beta2: beta2 as f32,
            keep1: (1.0 - beta1) as f32,
            keep2: (1.0 - beta2) as f32,
            rate: (rate / (1.0 - beta1.powf(number))) as f32,
            root: (1.0 / (1.0 - beta2.powf(number)).sqrt()) as f32,
            eps: eps as f32,
        }
    }

    fn run(self, grad: &[f32], var: &mut [f32], mean: &mut [f32], square: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || {
                for (((g, x), m), v) in grad.iter().zip(var).zip(mean).zip(square) {
                    let g = g * self.scale;
                    *m = self.beta1.mul_add(*m, self.keep1 * g);
                    *v = self.beta2.mul_add(*v, self.keep2 * g * g);
                    *x -= self.rate * *m / v.sqrt().mul_add(self.root, self.eps);
                }
            },
        );
    }

    fn fused(self, [var, mean, square]: [&Var; 3], grad: &Tensor) -> Result<()> {
        let count = grad.elem_count();
        if [var, mean, square].iter().any(|x| x.elem_count() != count) {
            return mismatch(OP, var, grad);
        }
        let grad = floats(OP, grad)?;
        // Three locks on three tensors, always taken in this order.
        var.inplace_op1(&InPlace(Mutex::new(|var: &mut [f32]| {
            mean.inplace_op1(&InPlace(Mutex::new(|mean: &mut [f32]| {
                square.inplace_op1(&InPlace(Mutex::new(|square: &mut [f32]| {
                    let grad = &*grad;
                    let shares = parallel::shares(grad.len(), 1 << 16);
                    let parts = parallel::split(var, &shares, 1).into_iter();
                    let parts =
                        parts.zip(parallel::split(mean, &shares, 1)).zip(parallel::split(square, &shares, 1));
                    parallel::each(&shares, parts, |share, ((var, mean), square)| {
                        self.run(&grad[share], var, mean, square);
                    });
                    Ok(())
                })))
            })))
        })))
    }

    fn composite(self, [var, mean, square]: [&Var; 3], grad: &Tensor) -> Result<()> {
        let affine = |x: &Tensor, factor: f32| x.affine(f64::from(factor), 0.0);
        let grad = affine(&grad.detach(), self.scale)?;
        let next_mean = (affine(mean, self.beta1)? + affine(&grad, self.keep1)?)?.detach();
        let next_square = (affine(square, self.beta2)? + affine(&grad.sqr()?, self.keep2)?)?.detach();
        let root = next_square.sqrt()?.affine(f64::from(self.root), f64::from(self.eps))?;
        let next = (var.as_detached_tensor() - affine(&next_mean, self.rate)?.div(&root)?)?;
        mean.set(&next_mean)?;
        square.set(&next_square)?;
        var.set(&next)
    }
}

/// Runs a closure on a contiguous f32 tensor's numbers, for writing.
struct InPlace<F>(Mutex<F>);

impl<F: FnMut(&mut [f32]) -> Result<()>> InplaceOp1 for InPlace<F> {
    fn name(&self) -> &'static str {
        "adam"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
        let (CpuStorage::F32(values), Some((from, to))) = (storage, layout.contiguous_offsets()) else {
            candle_core::bail!("adam: expected a contiguous f32 tensor");
        };
        let mut body = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        (*body)(&mut values[from..to])
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    fn var(values: &[f32]) -> Var {
        Var::from_slice(values, values.len(), &Device::Cpu).unwrap()
    }

    fn zeros(like: &Var) -> Var {
        Var::from_tensor(&like.zeros_like().unwrap()).unwrap()
    }

    fn numbers(x: &Tensor) -> Vec<f32> {
        x.to_vec1().unwrap()
    }

    fn step(number: u64) -> AdamStep {
        AdamStep { number, scale: 0.7, rate: 0.05, beta1: 0.9, beta2: 0.999, eps: 1e-3 }
    }

    #[test]
    fn steps_equal_the_textbook() {
        let start: Vec<f32> = (0..100_003).map(|i| (i % 17) as f32 / 8.0 - 1.0).collect();
        let x = var(&start);
        let (mean, square) = (zeros(&x), zeros(&x));
        let mut expected: Vec<[f64; 3]> = start.iter().map(|x| [f64::from(*x), 0.0, 0.0]).collect();
        for number in 1..=5 {
            let s = step(number);
            // The gradient of x^2 / 2.
            adam_step(&x, &mean, &square, &x.copy().unwrap().detach(), &s).unwrap();
            let correct = |beta: f64| 1.0 - beta.powf(number as f64);
            for [x, m, v] in &mut expected {
                let g = *x * s.scale;
                *m = s.beta1 * *m + (1.0 - s.beta1) * g;
                *v = s.beta2 * *v + (1.0 - s.beta2) * g * g;
                *x -= s.rate * (*m / correct(s.beta1)) / ((*v / correct(s.beta2)).sqrt() + s.eps);
            }
        }
        let pairs = numbers(&x).into_iter().zip(&expected);
        let worst = pairs.map(|(a, [b, ..])| (f64::from(a) - b).abs()).fold(0.0, f64::max);
        assert!(worst < 2e-5, "{worst:e}");
    }

    #[test]
    fn the_fused_step_equals_the_composite() {
        let kernel = Kernel::new(&step(3));
        let grad = Tensor::new(&[0.3f32, 0.0, -4.0], &Device::Cpu).unwrap();
        let (a, b) = (var(&[1.0, -2.0, 0.5]), var(&[1.0, -2.0, 0.5]));
        let (fused, composite) = ([zeros(&a), zeros(&a)], [zeros(&b), zeros(&b)]);
        for _ in 0..3 {
            kernel.fused([&a, &fused[0], &fused[1]], &grad).unwrap();
            kernel.composite([&b, &composite[0], &composite[1]], &grad).unwrap();
        }
        for (found, expected) in numbers(&a).iter().zip(numbers(&b)) {
            assert!((found - expected).abs() <= 1e-6, "{found} {expected}");
        }
    }

    #[test]
    fn moments_of_another_size_are_refused() {
        let (x, y) = (var(&[1.0, 2.0]), var(&[1.0]));
        assert!(adam_step(&x, &zeros(&y), &zeros(&x), &x.copy().unwrap(), &step(1)).is_err());
    }

    #[test]
    fn squares_are_summed_beyond_the_precision_of_f32() {
        let x = Tensor::full(1f32, 40_000_001, &Device::Cpu).unwrap();
        assert_eq!(sum_of_squares(&x).unwrap(), 40_000_001.0);
    }
}
