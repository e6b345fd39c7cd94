//! The tensors that enter and leave parts.

use serde::{Deserialize, Serialize};

use crate::onnx;

/// A tensor that enters or leaves a part.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TensorSpec {
    /// Name in the graph.
    pub name: String,
    /// Element type.
    pub dtype: DType,
    /// Every dimension is fixed.
    pub shape: Vec<usize>,
}

impl TensorSpec {
    /// A tensor of this name, type and shape.
    #[must_use]
    pub fn new(name: &str, dtype: DType, shape: &[usize]) -> Self {
        Self { name: name.to_owned(), dtype, shape: shape.to_vec() }
    }
}

/// Element types that cross a part's border.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DType {
    /// 8-bit unsigned: images.
    U8,
    /// 64-bit signed: class indices.
    I64,
    /// 32-bit float.
    F32,
}

impl DType {
    /// The name, as in manifests.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::U8 => "u8",
            Self::I64 => "i64",
            Self::F32 => "f32",
        }
    }

    /// The ONNX number of this type.
    #[must_use]
    pub const fn to_onnx(self) -> i32 {
        match self {
            Self::U8 => onnx::data_type::UINT8,
            Self::I64 => onnx::data_type::INT64,
            Self::F32 => onnx::data_type::FLOAT,
        }
    }

    /// The type of an ONNX number, if it is one that crosses a part's border.
    #[must_use]
    pub const fn from_onnx(number: i32) -> Option<Self> {
        match number {
            onnx::data_type::UINT8 => Some(Self::U8),
            onnx::data_type::INT64 => Some(Self::I64),
            onnx::data_type::FLOAT => Some(Self::F32),
            _ => None,
        }
    }
}
