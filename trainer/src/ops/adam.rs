//! Adam with clipping by the global norm, over a list of named variables.

use std::collections::BTreeMap;
use std::sync::Mutex;

use candle_core::backprop::GradStore;
use candle_core::{CpuStorage, DType, InplaceOp1, Layout, Result, Tensor, Var};

use super::kernels::{parallel, vectorised};
use super::node::{floats, fusible};

/// Step size and decay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamSettings {
    /// Learning rate.
    pub rate: f64,
    /// Decay of the mean of gradients.
    pub beta1: f64,
    /// Decay of the mean of squares.
    pub beta2: f64,
    /// Added to the square root of the mean of squares.
    pub eps: f64,
    /// Largest norm of all gradients together; larger ones are scaled down to it.
    pub clip: Option<f64>,
}

impl AdamSettings {
    /// PyTorch's defaults at this rate.
    #[must_use]
    pub fn new(rate: f64) -> Self {
        Self { rate, beta1: 0.9, beta2: 0.999, eps: 1e-8, clip: None }
    }
}

/// One variable and its moments.
#[derive(Debug)]
struct Slot {
    name: String,
    var: Var,
    mean: Tensor,
    square: Tensor,
}

/// The optimiser's state, for checkpoints.
#[derive(Debug, Clone)]
pub struct AdamState {
    /// Updates made.
    pub step: u64,
    /// `<variable>.mean` and `<variable>.square`.
    pub tensors: BTreeMap<String, Tensor>,
}

/// Adam as in PyTorch: bias correction, epsilon outside the square root. Cost a number: 28 bytes and 15 flops, and 4 bytes for the norm.
#[derive(Debug)]
pub struct Adam {
    settings: AdamSettings,
    slots: Vec<Slot>,
    step: u64,
}

impl Adam {
    /// Zero moments for these variables.
    ///
    /// # Errors
    /// Those of candle.
    pub fn new(variables: impl IntoIterator<Item = (String, Var)>, settings: AdamSettings) -> Result<Self> {
        let slot = |(name, var): (String, Var)| {
            let zeros = || Tensor::zeros(var.shape(), DType::F32, var.device());
            Ok(Slot { mean: zeros()?, square: zeros()?, name, var })
        };
        let slots = variables.into_iter().map(slot).collect::<Result<_>>()?;
        Ok(Self { settings, slots, step: 0 })
    }

    /// The settings; the rate may be changed between updates.
    pub fn settings_mut(&mut self) -> &mut AdamSettings {
        &mut self.settings
    }

    /// Updates made so far.
    #[must_use]
    pub fn step(&self) -> u64 {
        self.step
    }

    /// Updates every variable that has a gradient, in place; gives the norm of all gradients before clipping.
    ///
    /// A norm that is not finite changes nothing: the update is skipped and the norm returned, for the caller to judge.
    ///
    /// # Errors
    /// Those of candle.
    pub fn update(&mut self, grads: &GradStore) -> Result<f64> {
        let pairs: Vec<(&Slot, Tensor)> = self
            .slots
            .iter()
            .filter_map(|slot| grads.get(&slot.var).map(|grad| Ok((slot, grad.contiguous()?))))
            .collect::<Result<_>>()?;
        let norm = norm(&pairs)?;
        if !norm.is_finite() {
            return Ok(norm);
        }
        self.step += 1;
        let AdamSettings { rate, beta1, beta2, eps, clip } = self.settings;
        let steps = self.step as f64;
        let kernel = Kernel {
            // As torch.nn.utils.clip_grad_norm_: the norm is kept from 0 by 1e-6, and never scaled up to the limit.
            scale: clip.map_or(1.0, |clip| (clip / (norm + 1e-6)).min(1.0)) as f32,
            beta1: beta1 as f32,
            beta2: beta2 as f32,
            keep1: (1.0 - beta1) as f32,
            keep2: (1.0 - beta2) as f32,
            rate: (rate / (1.0 - beta1.powf(steps))) as f32,
            root: (1.0 / (1.0 - beta2.powf(steps)).sqrt()) as f32,
            eps: eps as f32,
        };
        for (slot, grad) in &pairs {
            if fusible(&[&slot.var, grad]) {
                kernel.fused(slot, grad)?;
            } else {
                kernel.composite(slot, grad)?;
            }
        }
        Ok(norm)
    }

    /// What must be saved to go on later.
    ///
    /// # Errors
    /// Those of candle.
    pub fn state(&self) -> Result<AdamState> {
        let mut tensors = BTreeMap::new();
        for slot in &self.slots {
            tensors.insert(format!("{}.mean", slot.name), slot.mean.copy()?);
            tensors.insert(format!("{}.square", slot.name), slot.square.copy()?);
        }
        Ok(AdamState { step: self.step, tensors })
    }

    /// Goes on from a saved state.
    ///
    /// # Errors
    /// If a tensor is missing or of another shape.
    pub fn restore(&mut self, state: &AdamState) -> Result<()> {
        let get = |name: &str, part: &str, like: &Tensor| -> Result<Tensor> {
            let name = format!("{name}.{part}");
            let Some(found) = state.tensors.get(&name) else {
                candle_core::bail!("adam: the saved state has no tensor {name}");
            };
            if found.shape() != like.shape() || found.dtype() != DType::F32 {
                let (shape, expected) = (found.shape(), like.shape());
                candle_core::bail!(
                    "adam: saved {name} is {shape:?} {:?}, expected {expected:?} F32",
                    found.dtype()
                );
            }
            found.to_device(like.device())?.copy()
        };
        let moments = self
            .slots
            .iter()
            .map(|slot| Ok((get(&slot.name, "mean", &slot.mean)?, get(&slot.name, "square", &slot.square)?)));
        let moments = moments.collect::<Result<Vec<_>>>()?;
        for (slot, (mean, square)) in self.slots.iter_mut().zip(moments) {
            (slot.mean, slot.square) = (mean, square);
        }
        self.step = state.step;
        Ok(())
    }
}

/// The 2-norm of all gradients together, summed in f64.
fn norm(pairs: &[(&Slot, Tensor)]) -> Result<f64> {
    let mut total = 0.0;
    for (_, grad) in pairs {
        total += if fusible(&[grad]) {
            squares(&floats("adam", grad)?)
        } else {
            f64::from(grad.sqr()?.sum_all()?.to_scalar::<f32>()?)
        };
    }
    Ok(total.sqrt())
}

/// Sum of squares: f32 lanes over short runs, f64 over the runs.
fn squares(grad: &[f32]) -> f64 {
    vectorised(
        #[inline(always)]
        || {
            let mut total = 0.0;
            for run in grad.chunks(2048) {
                total += f64::from(super::kernels::math::sum_of(
                    run,
                    #[inline(always)]
                    |x| x * x,
                ));
            }
            total
        },
    )
}

/// The numbers of one update.
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

    fn fused(self, slot: &Slot, grad: &Tensor) -> Result<()> {
        let grad = floats("adam", grad)?;
        // Three locks on three tensors, always taken in this order.
        slot.var.inplace_op1(&InPlace(Mutex::new(|var: &mut [f32]| {
            slot.mean.inplace_op1(&InPlace(Mutex::new(|mean: &mut [f32]| {
                slot.square.inplace_op1(&InPlace(Mutex::new(|square: &mut [f32]| {
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

    fn composite(self, slot: &Slot, grad: &Tensor) -> Result<()> {
        let affine = |x: &Tensor, factor: f32| x.affine(f64::from(factor), 0.0);
        let grad = affine(&grad.detach(), self.scale)?;
        let mean = (affine(&slot.mean, self.beta1)? + affine(&grad, self.keep1)?)?;
        let square = (affine(&slot.square, self.beta2)? + affine(&grad.sqr()?, self.keep2)?)?;
        let root = square.sqrt()?.affine(f64::from(self.root), f64::from(self.eps))?;
        let next = (slot.var.as_detached_tensor() - affine(&mean, self.rate)?.div(&root)?)?;
        slot.mean.slice_set(&mean.reshape(slot.mean.shape())?, 0, 0)?;
        slot.square.slice_set(&square.reshape(slot.square.shape())?, 0, 0)?;
        slot.var.set(&next)
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

    fn numbers(x: &Tensor) -> Vec<f32> {
        x.to_vec1().unwrap()
    }

    /// Gradients of `sum(weights * x^2) / 2`, which are `weights * x`.
    fn grads(vars: &[&Var]) -> GradStore {
        let term = |var: &&Var| (var.sqr().unwrap() * 0.5).unwrap().sum_all().unwrap();
        let loss = vars.iter().map(term).reduce(|a, b| (a + b).unwrap()).unwrap();
        loss.backward().unwrap()
    }

    /// PyTorch's Adam in f64, gradient x, norm clipped.
    fn reference(x: &mut [f64], settings: AdamSettings, updates: i32) {
        let (mut mean, mut square) = (vec![0.0; x.len()], vec![0.0; x.len()]);
        for step in 1..=updates {
            let norm = x.iter().map(|x| x * x).sum::<f64>().sqrt();
            let scale = settings.clip.map_or(1.0, |clip| (clip / (norm + 1e-6)).min(1.0));
            for i in 0..x.len() {
                let g = x[i] * scale;
                mean[i] = settings.beta1 * mean[i] + (1.0 - settings.beta1) * g;
                square[i] = settings.beta2 * square[i] + (1.0 - settings.beta2) * g * g;
                let (m, v) = (
                    mean[i] / (1.0 - settings.beta1.powi(step)),
                    square[i] / (1.0 - settings.beta2.powi(step)),
                );
                x[i] -= settings.rate * m / (v.sqrt() + settings.eps);
            }
        }
    }

    #[test]
    fn updates_equal_the_textbook_with_and_without_clipping() {
        for clip in [None, Some(1e3), Some(0.5)] {
            let settings = AdamSettings { clip, eps: 1e-3, ..AdamSettings::new(0.05) };
            let start: Vec<f32> = (0..100_003).map(|i| (i % 17) as f32 / 8.0 - 1.0).collect();
            let (x, y) = (var(&start[..3]), var(&start[3..]));
            let mut adam = Adam::new([("x".into(), x.clone()), ("y".into(), y.clone())], settings).unwrap();
            for _ in 0..5 {
                adam.update(&grads(&[&x, &y])).unwrap();
            }
            let mut expected: Vec<f64> = start.iter().map(|x| f64::from(*x)).collect();
            reference(&mut expected, settings, 5);
            let found = [numbers(&x), numbers(&y)].concat();
            let worst =
                found.iter().zip(&expected).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
            assert!(worst < 2e-5, "{clip:?}: {worst:e}");
        }
    }

    #[test]
    fn the_fused_update_equals_the_composite() {
        let settings = AdamSettings::new(0.1);
        let (a, b) = (var(&[1.0, -2.0, 0.5]), var(&[1.0, -2.0, 0.5]));
        let zeros = || Tensor::zeros(3, DType::F32, &Device::Cpu).unwrap();
        let slot = |var: &Var| Slot { name: "x".into(), var: var.clone(), mean: zeros(), square: zeros() };
        let kernel = Kernel {
            scale: 0.7,
            beta1: 0.9,
            beta2: 0.999,
            keep1: 0.1,
            keep2: 0.001,
            rate: settings.rate as f32,
            root: 1.5,
            eps: 1e-8,
        };
        let grad = Tensor::new(&[0.3f32, 0.0, -4.0], &Device::Cpu).unwrap();
        let (fused, composite) = (slot(&a), slot(&b));
        for _ in 0..3 {
            kernel.fused(&fused, &grad).unwrap();
            kernel.composite(&composite, &grad).unwrap();
        }
        for (found, expected) in numbers(&a).iter().zip(numbers(&b)) {
            assert!((found - expected).abs() <= 1e-6, "{found} {expected}");
        }
    }

    #[test]
    fn a_saved_state_goes_on_bit_for_bit() {
        let settings = AdamSettings { clip: Some(1.0), ..AdamSettings::new(0.01) };
        let x = var(&[1.0, -2.0, 0.5]);
        let mut adam = Adam::new([("x".into(), x.clone())], settings).unwrap();
        adam.update(&grads(&[&x])).unwrap();
        let (state, halfway) = (adam.state().unwrap(), numbers(&x));
        adam.update(&grads(&[&x])).unwrap();
        let y = var(&halfway);
        let mut resumed = Adam::new([("x".into(), y.clone())], settings).unwrap();
        resumed.restore(&state).unwrap();
        resumed.update(&grads(&[&y])).unwrap();
        assert_eq!((numbers(&x), adam.step()), (numbers(&y), resumed.step()));
        let mut other = Adam::new([("z".into(), y)], settings).unwrap();
        assert!(other.restore(&state).unwrap_err().to_string().contains("z.mean"));
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing() {
        let x = var(&[1.0, f32::INFINITY]);
        let mut adam = Adam::new([("x".into(), x.clone())], AdamSettings::new(0.1)).unwrap();
        assert!(!adam.update(&grads(&[&x])).unwrap().is_finite());
        assert_eq!((numbers(&x), adam.step()), (vec![1.0, f32::INFINITY], 0));
    }
}
