//! Results in memory that is used again.

use std::sync::Arc;

use tract_onnx::tract_hir::internal::*;

/// Tensors of one shape that results are written into, in turn.
#[derive(Debug, Clone)]
pub(super) struct Results {
    dtype: DatumType,
    shape: TVec<usize>,
    tensors: Vec<Arc<Tensor>>,
}

impl Results {
    pub(super) fn new(dtype: DatumType, shape: &[usize]) -> Self {
        Self { dtype, shape: shape.into(), tensors: Vec::new() }
    }

    /// A tensor that nobody else reads, filled by `write`. Its old contents are what they were.
    pub(super) fn write<T: Datum>(
        &mut self,
        write: impl FnOnce(&mut [T]) -> TractResult<()>,
    ) -> TractResult<TVec<TValue>> {
        let free = self.tensors.iter_mut().position(|tensor| Arc::get_mut(tensor).is_some());
        let index = match free {
            Some(index) => index,
            None => {
                self.tensors.push(Arc::new(Tensor::zero_dt(self.dtype, &self.shape)?));
                self.tensors.len() - 1
            }
        };
        if let Some(tensor) = Arc::get_mut(&mut self.tensors[index]) {
            write(tensor.try_as_plain_ram_mut()?.as_slice_mut::<T>()?)?;
        }
        Ok(tvec!(Arc::clone(&self.tensors[index]).into_tvalue()))
    }
}

/// The contents of an input.
pub(super) fn slice<T: Datum>(value: &TValue) -> TractResult<&[T]> {
    value.try_as_plain_ram()?.as_slice::<T>()
}
