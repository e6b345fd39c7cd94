//! The state that every episode starts from.

use super::error::BundleError;
use super::kind::PartName;
use super::manifest::Manifest;
use super::recurrent::PolicySignature;
use crate::tensors::{Tensors, TensorsError};

/// The state every episode starts from.
#[derive(Debug, Clone, PartialEq)]
pub struct InitialState {
    /// `h_0 = tanh(w)` and `z_0` = mode of the prior at `h_0` of each branch, in the kind's order; of a policy without a world model one
    /// that has all carried numbers as its h.
    pub branches: Vec<InitialBranch>,
}

/// The state a branch starts from.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InitialBranch {
    /// n class indices.
    pub z: Vec<i64>,
    /// d numbers.
    pub h: Vec<f32>,
}

pub(super) fn read_initial(manifest: &Manifest, tensors: &Tensors) -> Result<InitialState, BundleError> {
    let wrong = |source| BundleError::Tensors { file: manifest.initial.file.clone(), source };
    let h = |name: &str, shape: &[usize]| -> Result<Vec<f32>, BundleError> {
        let array = tensors.f32(name).map_err(wrong)?;
        if array.shape() != shape || array.iter().any(|x| !x.is_finite()) {
            let found = format!("{:?}", array.shape());
            let expected = format!("finite, {shape:?}");
            return Err(wrong(TensorsError::Unexpected { name: name.to_owned(), found, expected }));
        }
        Ok(array.iter().copied().collect())
    };
    let Some(model) = &manifest.model else {
        let mut all = InitialBranch::default();
        for entry in &manifest.parts {
            for carried in PolicySignature::of(manifest, entry)?.carried {
                all.h.extend(h(&carried.name, &carried.shape)?);
            }
        }
        return Ok(InitialState { branches: vec![all] });
    };
    let z = |name: &str| -> Result<Vec<i64>, BundleError> {
        let array = tensors.i64(name).map_err(wrong)?;
        let classes = 0..model.classes as i64;
        if array.shape() != [1, model.categoricals] || array.iter().any(|class| !classes.contains(class)) {
            let found = format!("{:?}", array.shape());
            let expected = format!("[1, {}] of classes 0 to {}", model.categoricals, model.classes - 1);
            return Err(wrong(TensorsError::Unexpected { name: name.to_owned(), found, expected }));
        }
        Ok(array.iter().copied().collect())
    };
    let branch = |branch: &PartName| -> Result<InitialBranch, BundleError> {
        let h = h(&format!("{branch}/h"), &[1, model.deter])?;
        Ok(InitialBranch { h, z: z(&format!("{branch}/z"))? })
    };
    Ok(InitialState { branches: manifest.kind.branches().iter().map(branch).collect::<Result<_, _>>()? })
}
