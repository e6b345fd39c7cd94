//! The state that every episode starts from.

use std::cell::RefCell;
use std::collections::BTreeSet;

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

/// What every episode starts from; the tensors hold that and nothing else.
pub(super) fn read_initial(manifest: &Manifest, tensors: &Tensors) -> Result<InitialState, BundleError> {
    let taken = RefCell::new(BTreeSet::new());
    let initial = read_taken(manifest, tensors, &taken)?;
    let taken = taken.into_inner();
    match tensors.0.keys().find(|name| !taken.contains(*name)) {
        None => Ok(initial),
        Some(name) => {
            let expected = match taken.is_empty() {
                true => "nothing: no state is carried".to_owned(),
                false => format!("only {}", taken.into_iter().collect::<Vec<_>>().join(", ")),
            };
            let source = TensorsError::Unexpected { name: name.clone(), found: "there".into(), expected };
            Err(BundleError::Tensors { file: manifest.initial.file.clone(), source })
        }
    }
}

fn read_taken(
    manifest: &Manifest,
    tensors: &Tensors,
    taken: &RefCell<BTreeSet<String>>,
) -> Result<InitialState, BundleError> {
    let wrong = |source| BundleError::Tensors { file: manifest.initial.file.clone(), source };
    let h = |name: &str, shape: &[usize]| -> Result<Vec<f32>, BundleError> {
        taken.borrow_mut().insert(name.to_owned());
        let array = tensors.f32(name).map_err(wrong)?;
        let invalid = array.iter().find(|x| !x.is_finite()).map(|x| format!("a tensor that holds {x}"));
        if array.shape() != shape || invalid.is_some() {
            let found = invalid.unwrap_or_else(|| format!("{:?}", array.shape()));
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
        taken.borrow_mut().insert(name.to_owned());
        let array = tensors.i64(name).map_err(wrong)?;
        let classes = 0..model.classes as i64;
        let invalid = array.iter().find(|class| !classes.contains(class));
        let invalid = invalid.map(|class| format!("a tensor that holds class {class}"));
        if array.shape() != [1, model.categoricals] || invalid.is_some() {
            let found = invalid.unwrap_or_else(|| format!("{:?}", array.shape()));
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
