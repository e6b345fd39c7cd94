//! Named arrays in safetensors files: golden values, initial states.

use std::collections::BTreeMap;

use ndarray::{ArrayD, IxDyn};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

/// One array.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// 32-bit floats.
    F32(ArrayD<f32>),
    /// 64-bit signed integers: class indices.
    I64(ArrayD<i64>),
    /// Bytes: images and flags.
    U8(ArrayD<u8>),
}

impl Values {
    #[must_use]
    pub fn shape(&self) -> &[usize] {
        match self {
            Self::F32(array) => array.shape(),
            Self::I64(array) => array.shape(),
            Self::U8(array) => array.shape(),
        }
    }

    fn type_name(&self) -> &'static str {
        match self {
            Self::F32(_) => "f32",
            Self::I64(_) => "i64",
            Self::U8(_) => "u8",
        }
    }

    fn to_le_bytes(&self) -> (Dtype, Vec<u8>) {
        match self {
            Self::F32(array) => (Dtype::F32, array.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Self::I64(array) => (Dtype::I64, array.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Self::U8(array) => (Dtype::U8, array.iter().copied().collect()),
        }
    }
}

/// Longest header accepted of a file that holds few arrays, in bytes: some hundred of them.
const FEW_HEADER_BYTES_MAX: u64 = 1 << 16;

/// Why named arrays could not be read.
#[derive(Debug, thiserror::Error)]
pub enum TensorsError {
    /// Not a safetensors file, or a damaged one.
    #[error("not a readable safetensors file: {0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// It describes more arrays than such a file has.
    #[error("a header of {found} bytes, at most {FEW_HEADER_BYTES_MAX} are accepted; export the file again")]
    Header {
        /// Length that the file states.
        found: u64,
    },
    /// An element type that these files do not use.
    #[error("tensor {name:?} has type {found}, expected f32, i64 or u8")]
    DType {
        /// The tensor.
        name: String,
        /// Its type.
        found: String,
    },
    /// A tensor is missing.
    #[error("tensor {name:?} is missing")]
    Missing {
        /// The tensor.
        name: String,
    },
    /// A tensor has another type or shape than it must have.
    #[error("tensor {name:?} is {found}, expected {expected}")]
    Unexpected {
        /// The tensor.
        name: String,
        found: String,
        /// What it must be.
        expected: String,
    },
}

/// Named arrays, sorted by name.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Tensors(pub BTreeMap<String, Values>);

impl Tensors {
    /// Parses a safetensors file.
    ///
    /// # Errors
    /// [`TensorsError::Format`] or [`TensorsError::DType`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, TensorsError> {
        let file = SafeTensors::deserialize(bytes)?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.tensors() {
            tensors.insert(name.clone(), read_view(&name, &view)?);
        }
        Ok(Self(tensors))
    }

    /// The same of a file from outside that holds some tens of arrays: a longer header, which takes many times its length in memory, is
    /// refused before it is read.
    ///
    /// # Errors
    /// [`TensorsError::Header`], or as [`Self::from_bytes`].
    pub fn of_few(bytes: &[u8]) -> Result<Self, TensorsError> {
        match bytes.first_chunk::<8>().map(|length| u64::from_le_bytes(*length)) {
            Some(found) if found > FEW_HEADER_BYTES_MAX => Err(TensorsError::Header { found }),
            _ => Self::from_bytes(bytes),
        }
    }

    /// Writes a safetensors file.
    ///
    /// # Errors
    /// [`TensorsError::Format`].
    pub fn to_bytes(&self) -> Result<Vec<u8>, TensorsError> {
        let data: Vec<_> = self
            .0
            .iter()
            .map(|(name, values)| (name, values.shape().to_vec(), values.to_le_bytes()))
            .collect();
        let views = data
            .iter()
            .map(|(name, shape, (dtype, bytes))| Ok((*name, TensorView::new(*dtype, shape.clone(), bytes)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
        Ok(safetensors::serialize(views, None)?)
    }

    /// An f32 array.
    ///
    /// # Errors
    /// [`TensorsError::Missing`] or [`TensorsError::Unexpected`].
    pub fn f32(&self, name: &str) -> Result<&ArrayD<f32>, TensorsError> {
        match self.get(name)? {
            Values::F32(array) => Ok(array),
            other => Err(wrong_type(name, other, "f32")),
        }
    }

    /// An i64 array.
    ///
    /// # Errors
    /// [`TensorsError::Missing`] or [`TensorsError::Unexpected`].
    pub fn i64(&self, name: &str) -> Result<&ArrayD<i64>, TensorsError> {
        match self.get(name)? {
            Values::I64(array) => Ok(array),
            other => Err(wrong_type(name, other, "i64")),
        }
    }

    /// A u8 array.
    ///
    /// # Errors
    /// [`TensorsError::Missing`] or [`TensorsError::Unexpected`].
    pub fn u8(&self, name: &str) -> Result<&ArrayD<u8>, TensorsError> {
        match self.get(name)? {
            Values::U8(array) => Ok(array),
            other => Err(wrong_type(name, other, "u8")),
        }
    }

    /// The array of this name, of whatever type.
    ///
    /// # Errors
    /// [`TensorsError::Missing`].
    pub fn get(&self, name: &str) -> Result<&Values, TensorsError> {
        self.0.get(name).ok_or_else(|| TensorsError::Missing { name: name.to_owned() })
    }
}

fn wrong_type(name: &str, found: &Values, expected: &str) -> TensorsError {
    TensorsError::Unexpected {
        name: name.to_owned(),
        found: found.type_name().to_owned(),
        expected: expected.to_owned(),
    }
}

fn read_view(name: &str, view: &TensorView<'_>) -> Result<Values, TensorsError> {
    let shape = IxDyn(view.shape());
    let bytes = view.data();
    let misshapen = |_| TensorsError::Unexpected {
        name: name.to_owned(),
        found: format!("{} bytes", bytes.len()),
        expected: format!("shape {:?}", view.shape()),
    };
    Ok(match view.dtype() {
        Dtype::F32 => {
            Values::F32(ArrayD::from_shape_vec(shape, words(bytes, f32::from_le_bytes)).map_err(misshapen)?)
        }
        Dtype::I64 => {
            Values::I64(ArrayD::from_shape_vec(shape, words(bytes, i64::from_le_bytes)).map_err(misshapen)?)
        }
        Dtype::U8 => Values::U8(ArrayD::from_shape_vec(shape, bytes.to_vec()).map_err(misshapen)?),
        other => return Err(TensorsError::DType { name: name.to_owned(), found: format!("{other:?}") }),
    })
}

fn words<const N: usize, T>(bytes: &[u8], from: fn([u8; N]) -> T) -> Vec<T> {
    bytes.as_chunks::<N>().0.iter().map(|word| from(*word)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr1;

    #[test]
    fn arrays_survive_the_file() {
        let mut tensors = Tensors::default();
        tensors.0.insert("a/h".into(), Values::F32(arr1(&[1.5, -0.0, f32::MIN_POSITIVE]).into_dyn()));
        tensors.0.insert("a/z".into(), Values::I64(arr1(&[3, -1]).into_dyn()));
        tensors.0.insert("image".into(), Values::U8(ArrayD::from_elem(IxDyn(&[2, 3]), 7)));
        let read = Tensors::from_bytes(&tensors.to_bytes().unwrap()).unwrap();
        assert_eq!(read, tensors);
        assert!(matches!(read.f32("a/z"), Err(TensorsError::Unexpected { .. })));
        assert!(matches!(read.f32("b"), Err(TensorsError::Missing { .. })));
    }

    #[test]
    fn a_header_of_thousands_of_arrays_is_refused_before_it_is_read() {
        let mut tensors = Tensors::default();
        for index in 0..2000 {
            tensors.0.insert(format!("{index}"), Values::U8(ArrayD::from_elem(IxDyn(&[0]), 0)));
        }
        let bytes = tensors.to_bytes().unwrap();
        assert!(matches!(Tensors::of_few(&bytes), Err(TensorsError::Header { .. })));
        assert_eq!(Tensors::from_bytes(&bytes).unwrap(), tensors);
    }

    #[test]
    fn a_truncated_file_is_an_error() {
        let mut tensors = Tensors::default();
        tensors.0.insert("a".into(), Values::F32(arr1(&[1.0, 2.0]).into_dyn()));
        let bytes = tensors.to_bytes().unwrap();
        for len in 0..bytes.len() {
            assert!(Tensors::from_bytes(&bytes[..len]).is_err(), "{len} bytes were accepted");
        }
    }
}
