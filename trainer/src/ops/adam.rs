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
