//! Fused operations in candle's graph: any number of inputs and outputs, with a hand-written backward pass.
//!
//! candle's custom ops take up to three inputs and give one output. A fused op computes its results at once, before it enters the graph. There
//! it is a node whose inputs beyond three hang on a chain of input shims, and whose outputs beyond one hang on it as output shims. Shims
//! carry a token of one number; gradients pass them by through [`ShimGradients`].
//!
//! ```text
//! x1, x2, x3 -> input shim -> input shim -> node -> output shim 1
//!         x4, x5 ----------------^              \-> output shim 2
//! ```

use std::ops::Deref;
use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, DType, Device, Error, Layout, Result, Shape, Storage,
    StorageRef, Tensor,
};

/// The backward pass of a fused op, with whatever the forward pass kept for it.
pub trait Backward: Send + Sync {
    /// Name in error messages.
    fn name(&self) -> &'static str;

    /// Gradients of the inputs, in their order; none where none is asked for (`wanted`) or where it is zero. `grads` are the outputs',
    /// none where nothing depends on an output.
    fn backward(&self, grads: &[Option<Tensor>], wanted: &[bool]) -> Result<Vec<Option<Tensor>>>;
}

/// Whether the fused kernels can take these tensors: f32 on the CPU.
pub fn fusible(tensors: &[&Tensor]) -> bool {
    tensors.iter().all(|x| matches!(x.device(), Device::Cpu) && x.dtype() == DType::F32)
}

/// A contiguous tensor's numbers.
pub struct Floats<'a> {
    storage: StorageRef<'a>,
    from: usize,
    to: usize,
}

impl Deref for Floats<'_> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &*self.storage {
            Storage::Cpu(CpuStorage::F32(values)) => &values[self.from..self.to],
            _ => unreachable!("`floats` gives out f32 tensors on the CPU only"),
        }
    }
}

/// The numbers of a contiguous f32 tensor on the CPU.
///
/// # Errors
/// If it is something else.
pub fn floats<'a>(op: &'static str, x: &'a Tensor) -> Result<Floats<'a>> {
    let (storage, layout) = x.storage_and_layout();
    let Some((from, to)) = layout.contiguous_offsets() else {
        return Err(Error::RequiresContiguous { op }.bt());
    };
    if !matches!(&*storage, Storage::Cpu(CpuStorage::F32(_))) {
        candle_core::bail!(
            "{op}: expected f32 on the CPU, found {:?} on {:?}",
            x.dtype(),
            x.device().location()
        );
    }
    Ok(Floats { storage, from, to })
}

/// A matrix whose columns are contiguous, and the distance of its rows: a slice of the columns of a larger one needs no copy.
///
/// # Errors
/// If it is not of that kind.
pub fn row_strided<'a>(op: &'static str, x: &'a Tensor) -> Result<Option<(Floats<'a>, usize)>> {
    let (rows, columns) = x.dims2()?;
    let (storage, layout) = x.storage_and_layout();
    let [row_stride, 1] = *layout.stride() else { return Ok(None) };
    if rows == 0 || row_stride < columns {
        return Ok(None);
    }
    if !matches!(&*storage, Storage::Cpu(CpuStorage::F32(_))) {
        candle_core::bail!(
            "{op}: expected f32 on the CPU, found {:?} on {:?}",
            x.dtype(),
            x.device().location()
        );
    }
    let from = layout.start_offset();
    Ok(Some((Floats { storage, from, to: from + (rows - 1) * row_stride + columns }, row_stride)))
}

/// A mismatch of shapes, as candle words it.
///
/// # Errors
/// Always.
pub fn mismatch<T>(op: &'static str, lhs: &Tensor, rhs: &Tensor) -> Result<T> {
    Err(Error::ShapeMismatchBinaryOp { lhs: lhs.shape().clone(), rhs: rhs.shape().clone(), op }.bt())
}

/// Puts results into the graph: tensors of these numbers and shapes, whose gradients reach `inputs` through `op`.
pub fn record(
    inputs: &[&Tensor],
    outputs: Vec<(Vec<f32>, Shape)>,
    op: impl Backward + 'static,
) -> Result<Vec<Tensor>> {
    let wanted: Vec<bool> = inputs.iter().map(|input| input.track_op()).collect();
    let tracked: Vec<&Tensor> =
        inputs.iter().zip(&wanted).filter(|(_, wanted)| **wanted).map(|(x, _)| *x).collect();
    if tracked.is_empty() {
        return outputs
            .into_iter()
            .map(|(values, shape)| Tensor::from_vec(values, shape, &Device::Cpu))
            .collect();
    }
    let gradients = Arc::new(Mutex::new(ShimGradients::default()));
    let input_shim = |first: usize, count: usize| InputShim { gradients: gradients.clone(), first, count };
    let token = match *tracked.as_slice() {
        [x] => x.apply_op1(input_shim(0, 1))?,
        [x, y] => x.apply_op2(y, input_shim(0, 2))?,
        [x, y, z, ref rest @ ..] => {
            let mut token = x.apply_op3(y, z, input_shim(0, 3))?;
            for (index, pair) in rest.chunks(2).enumerate() {
                let first = 3 + 2 * index;
                token = match *pair {
                    [x, y] => token.apply_op3(x, y, Chained(input_shim(first, 2)))?,
                    [x] => token.apply_op2(x, Chained(input_shim(first, 1)))?,
                    _ => unreachable!("chunks of at most two"),
                };
            }
            token
        }
        [] => unreachable!("checked above"),
    };
    let count = outputs.len();
    let node =
        token.apply_op1(Node { gradients: gradients.clone(), wanted, outputs: count, op: Box::new(op) })?;
    let output_shim = |(index, (values, shape))| {
        node.apply_op1(OutputShim {
            gradients: gradients.clone(),
            index,
            output: Mutex::new(Some((values, shape))),
        })
    };
    outputs.into_iter().enumerate().map(output_shim).collect()
}

/// [`record`] for one output.
pub fn record_one(
    inputs: &[&Tensor],
    values: Vec<f32>,
    shape: impl Into<Shape>,
    op: impl Backward + 'static,
) -> Result<Tensor> {
    let mut outputs = record(inputs, vec![(values, shape.into())], op)?;
    Ok(outputs.swap_remove(0))
}

/// Gradients on their way past the tokens.
#[derive(Default)]
struct ShimGradients {
    outputs: Vec<Option<Tensor>>,
    inputs: Vec<Option<Tensor>>,
}

type Shared = Arc<Mutex<ShimGradients>>;

fn token() -> Result<(CpuStorage, Shape)> {
    Ok((CpuStorage::F32(vec![0.0]), Shape::from(1)))
}

fn token_grad() -> Result<Tensor> {
    Tensor::zeros(1, DType::F32, &Device::Cpu)
}

/// Hands gradients to up to three inputs.
struct InputShim {
    gradients: Shared,
    first: usize,
    count: usize,
}

impl InputShim {
    fn take(&self) -> [Option<Tensor>; 3] {
        let mut gradients = self.gradients.lock().unwrap_or_else(PoisonError::into_inner);
        let mut take = |index| {
            let slot = if index < self.count { gradients.inputs.get_mut(self.first + index) } else { None };
            slot.and_then(Option::take)
        };
        [take(0), take(1), take(2)]
    }
}

impl CustomOp1 for InputShim {
    fn name(&self) -> &'static str {
        "input-shim"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        token()
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor) -> Result<Option<Tensor>> {
        let [x, ..] = self.take();
        Ok(x)
    }
}

impl CustomOp2 for InputShim {
    fn name(&self) -> &'static str {
        "input-shim"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        token()
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [x, y, _] = self.take();
        Ok((x, y))
    }
}

impl CustomOp3 for InputShim {
    fn name(&self) -> &'static str {
        "input-shim"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        token()
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [x, y, z] = self.take();
        Ok((x, y, z))
    }
}

/// One whose first input is the token of the shim before.
struct Chained(InputShim);

impl CustomOp2 for Chained {
    fn name(&self) -> &'static str {
        "input-shim"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        token()
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [x, ..] = self.0.take();
        Ok((Some(token_grad()?), x))
    }
}

impl CustomOp3 for Chained {
    fn name(&self) -> &'static str {
        "input-shim"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        token()
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [x, y, _] = self.0.take();
        Ok((Some(token_grad()?), x, y))
    }
}

/// The op itself.
struct Node {
    gradients: Shared,
    wanted: Vec<bool>,
    outputs: usize,
    op: Box<dyn Backward>,
}

impl CustomOp1 for Node {
    fn name(&self) -> &'static str {
        self.op.name()
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        token()
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor) -> Result<Option<Tensor>> {
        let lock = || self.gradients.lock().unwrap_or_else(PoisonError::into_inner);
        let mut grads = std::mem::take(&mut lock().outputs);
        grads.resize(self.outputs, None);
        let grads = self.op.backward(&grads, &self.wanted)?;
        let asked = grads.into_iter().zip(&self.wanted).filter(|(_, wanted)| **wanted);
        lock().inputs = asked.map(|(grad, _)| grad).collect();
        Ok(Some(token_grad()?))
    }
}

struct OutputShim {
    gradients: Shared,
    index: usize,
    output: Mutex<Option<(Vec<f32>, Shape)>>,
}

impl CustomOp1 for OutputShim {
    fn name(&self) -> &'static str {
        "output-shim"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        let output = self.output.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some((values, shape)) = output else {
            candle_core::bail!("output shim: its output was taken before")
        };
        if values.len() != shape.elem_count() {
            candle_core::bail!("output shim: {} numbers for the shape {shape:?}", values.len());
        }
        Ok((CpuStorage::F32(values), shape))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let mut gradients = self.gradients.lock().unwrap_or_else(PoisonError::into_inner);
        if gradients.outputs.len() <= self.index {
            gradients.outputs.resize(self.index + 1, None);
        }
        gradients.outputs[self.index] = Some(grad.contiguous()?);
        Ok(Some(token_grad()?))
    }
}
