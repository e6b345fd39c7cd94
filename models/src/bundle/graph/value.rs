//! What is known of a value before anything runs.

use super::DType;
use crate::onnx::{Tensor, data_type};

/// Constants of at most this many integers are kept: shapes, axes, sizes.
const KEPT_MAX: usize = 16;

/// Type and shape; of integers also the range, and of small constants the numbers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Value {
    pub(super) dtype: DType,
    pub(super) shape: Vec<usize>,
    /// Smallest and largest value, of integers.
    pub(super) range: Option<(i64, i64)>,
    /// The numbers of a small constant of integers.
    pub(super) integers: Option<Vec<i64>>,
    /// It does not depend on any input.
    pub(super) is_constant: bool,
    /// An optional input that was left out.
    pub(super) is_absent: bool,
}

impl Value {
    pub(super) fn new(dtype: DType, shape: Vec<usize>) -> Self {
        Self { dtype, shape, range: None, integers: None, is_constant: false, is_absent: false }
    }

    /// An optional input that was left out.
    pub(super) fn absent() -> Self {
        Self { is_absent: true, ..Self::new(DType::F32, Vec::new()) }
    }

    /// A value like this one, in another shape.
    pub(super) fn reshaped(&self, shape: Vec<usize>) -> Self {
        Self { range: self.range, ..Self::new(self.dtype, shape) }
    }

    pub(super) fn constant(tensor: &Tensor, rank_max: usize) -> Result<Self, String> {
        let (dtype, bytes) = match tensor.data_type {
            data_type::FLOAT => (DType::F32, 4),
            data_type::INT64 => (DType::I64, 8),
            other => return Err(format!("has element type {other}, expected f32 or i64")),
        };
        let shape = tensor.dims.iter().map(|dim| usize::try_from(*dim).ok());
        let shape: Vec<usize> =
            shape.collect::<Option<_>>().ok_or_else(|| format!("has shape {:?}", tensor.dims))?;
        let mut value = Self { is_constant: true, ..Self::new(dtype, shape) };
        value.check(rank_max)?;
        if tensor.raw_data.is_empty() {
            return Err("has its numbers elsewhere than in raw_data; write them there (onnx.numpy_helper.from_array does)".into());
        }
        if value.elements().checked_mul(bytes) != Some(tensor.raw_data.len()) {
            let found = tensor.raw_data.len();
            return Err(format!("holds {found} bytes, its type and shape are {}", value.text()));
        }
        if dtype == DType::I64 {
            let integers = tensor.raw_data.as_chunks::<8>().0.iter().map(|word| i64::from_le_bytes(*word));
            value.range = integers.clone().min().zip(integers.clone().max());
            value.integers = (value.elements() <= KEPT_MAX).then(|| integers.collect());
        }
        Ok(value)
    }

    /// Every dimension is at least 1, there are few of them, and their product is a number.
    pub(super) fn check(&self, rank_max: usize) -> Result<(), String> {
        let product = self.shape.iter().try_fold(1_usize, |product, dim| product.checked_mul(*dim));
        match product {
            Some(1..) if self.shape.len() <= rank_max => Ok(()),
            _ => Err(format!(
                "has shape {:?}, expected at most {rank_max} dimensions of 1 or more",
                self.shape
            )),
        }
    }

    /// Number of elements; of a value that [`Self::check`] has passed.
    pub(super) fn elements(&self) -> usize {
        self.shape.iter().fold(1_usize, |product, dim| product.saturating_mul(*dim))
    }

    pub(super) fn rank(&self) -> usize {
        self.shape.len()
    }

    pub(super) fn text(&self) -> String {
        format!("{:?} {:?}", self.dtype, self.shape)
    }
}
