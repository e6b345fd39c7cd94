//! The package's exceptions, which are written in Python (`src/rcwm/errors.py`).

use pyo3::prelude::*;
use pyo3::types::PyType;
use rcwm_models::wire::LinkError;
use rcwm_runtime::PolicyError;

/// An exception of `rcwm.errors`, by its name.
pub(crate) fn error(py: Python<'_>, name: &str, text: impl ToString) -> PyErr {
    let class =
        py.import("rcwm.errors").and_then(|module| Ok(module.getattr(name)?.cast_into::<PyType>()?));
    match class {
        Ok(class) => PyErr::from_type(class, text.to_string()),
        Err(error) => error,
    }
}

/// What was given does not fit.
pub(crate) fn input(py: Python<'_>, text: impl ToString) -> PyErr {
    error(py, "InputError", text)
}

pub(crate) fn policy(py: Python<'_>, why: &PolicyError) -> PyErr {
    let name = match why {
        PolicyError::Bundle(_) => "BundleError",
        PolicyError::Observation(_) | PolicyError::NothingToSample => "InputError",
        PolicyError::NotFinite { .. } => "NotFinite",
        _ => "PolicyError",
    };
    error(py, name, why)
}

pub(crate) fn link(py: Python<'_>, why: &LinkError) -> PyErr {
    let text = why.to_string();
    let name = match why {
        LinkError::Memory { .. } => "SharedMemoryFull",
        LinkError::Taken { .. } => "LinkTaken",
        LinkError::DoesNotFit { .. } => "DoesNotFit",
        // What iceoryx2 says where a subscriber may hold no more messages.
        LinkError::Traffic { .. } if text.contains("ExceedsMaxBorrows") => {
            let held = "two observations, or arrays of theirs, are still held; drop them, or keep `observation.copy()`";
            return error(py, "LinkError", held);
        }
        _ => "LinkError",
    };
    error(py, name, text)
}
