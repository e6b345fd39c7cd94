//! An observation that was received, as arrays that lie where it lies.

use std::ffi::c_int;

use pyo3::exceptions::PyKeyError;
use pyo3::ffi;
use pyo3::prelude::*;
use rcwm_models::wire::{self, ObservationFlags, ObservationSample, OwnedObservation};

use crate::arrays::view;
use crate::bound::{Bin, ThreadBound};

/// A mapping of names to arrays: states, cameras' pictures and their masks (`<camera>_mask`).
#[pyclass(frozen, module = "rcwm._rcwm")]
pub(crate) struct Observation(Memory);

/// Where it lies.
enum Memory {
    /// In shared memory, until the last array of it is gone.
    Shared(ThreadBound<ObservationSample>),
    Own(OwnedObservation),
}

/// What of it has a name.
struct Part {
    name: String,
    /// Numpy's word for its numbers.
    dtype: &'static str,
    offset: usize,
    shape: Vec<usize>,
}

impl Observation {
    pub(crate) fn of(sample: ObservationSample, bin: &Bin<ObservationSample>) -> Self {
        Self(Memory::Shared(ThreadBound::new(sample, bin)))
    }

    fn view(&self) -> wire::Observation<'_> {
        match &self.0 {
            // SAFETY: where it lies and what it says is read, and does not change; no reference is counted.
            Memory::Shared(sample) => unsafe { sample.peek() }.view(),
            Memory::Own(observation) => observation.view(),
        }
    }

    fn parts(&self) -> Vec<Part> {
        let view = self.view();
        let (interface, layout) = (view.format().interface(), view.format().layout());
        let mut parts = Vec::new();
        let mut offset = layout.state.bytes.start;
        for state in &interface.state {
            let numbers = state.elements.len();
            parts.push(Part { name: state.name.clone(), dtype: "f4", offset, shape: vec![numbers] });
            offset += 4 * numbers;
        }
        for ((camera, picture), mask) in interface.camera.iter().zip(&layout.cameras).zip(&layout.masks) {
            let (name, shape) = (camera.name.clone(), camera.shape);
            parts.push(Part { name, dtype: "u1", offset: picture.bytes.start, shape: shape.to_vec() });
            if let Some(mask) = mask.as_ref().filter(|_| view.is(ObservationFlags::MASK_VALID)) {
                let name = format!("{}_mask", camera.name);
                parts.push(Part { name, dtype: "u1", offset: mask.bytes.start, shape: shape[..2].to_vec() });
            }
        }
        parts
    }
}

#[pymethods]
impl Observation {
    #[getter]
    fn sequence(&self) -> u64 {
        self.view().sequence
    }

    #[getter]
    fn episode(&self) -> u64 {
        self.view().episode
    }

    #[getter]
    fn step(&self) -> u32 {
        self.view().step
    }

    #[getter]
    fn flags<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        py.import("rcwm.messages")?.getattr("Flags")?.call1((self.view().flags,))
    }

    #[getter]
    fn task(&self) -> u32 {
        self.view().task
    }

    #[getter]
    fn reward(&self) -> f32 {
        self.view().reward
    }

    #[getter]
    fn period_ns(&self) -> u64 {
        self.view().period_ns
    }

    #[getter]
    fn scheduled_ns(&self) -> u64 {
        self.view().scheduled_ns
    }

    #[getter]
    fn published_ns(&self) -> u64 {
        self.view().published_ns
    }

    #[getter]
    fn captured_ns(&self) -> Vec<u64> {
        let view = self.view();
        view.captured_ns[..view.format().interface().camera.len()].to_vec()
    }

    #[getter]
    fn executed<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let format = slf.get().view().format();
        view(slf, "f4", format.action_numbers(), format.layout().executed.bytes.start)
    }

    #[getter]
    fn state<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let format = slf.get().view().format();
        view(slf, "f4", format.interface().state_numbers(), format.layout().state.bytes.start)
    }

    fn copy(&self) -> Self {
        Self(Memory::Own(self.view().into()))
    }

    fn keys(&self) -> Vec<String> {
        self.parts().into_iter().map(|part| part.name).collect()
    }

    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(self.keys().into_pyobject(py)?.try_iter()?.into_any())
    }

    fn __len__(&self) -> usize {
        self.parts().len()
    }

    fn __contains__(&self, name: &str) -> bool {
        self.parts().iter().any(|part| part.name == name)
    }

    fn __getitem__<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let found = slf.get().parts().into_iter().find(|part| part.name == name);
        let Part { dtype, offset, shape, .. } = found.ok_or_else(|| PyKeyError::new_err(name.to_owned()))?;
        let flat = view(slf, dtype, shape.iter().product(), offset)?;
        if shape.len() == 1 { Ok(flat) } else { flat.call_method1("reshape", (shape,)) }
    }

    /// What arrays are views of: the payload, read only.
    ///
    /// # Safety
    /// Python's, which gives a place to fill in.
    unsafe fn __getbuffer__(slf: &Bound<'_, Self>, to: *mut ffi::Py_buffer, flags: c_int) -> PyResult<()> {
        let payload = slf.get().view().payload();
        let (start, bytes) = (payload.as_ptr().cast_mut().cast(), payload.len() as ffi::Py_ssize_t);
        // SAFETY: see above; the payload lives as long as the object, of which the buffer takes a reference.
        match unsafe { ffi::PyBuffer_FillInfo(to, slf.as_ptr(), start, bytes, 1, flags) } {
            0 => Ok(()),
            _ => Err(PyErr::fetch(slf.py())),
        }
    }

    fn __repr__(&self) -> String {
        let view = self.view();
        let (sequence, episode, step) = (view.sequence, view.episode, view.step);
        format!(
            "Observation(sequence={sequence}, episode={episode}, step={step}: {})",
            self.keys().join(", ")
        )
    }
}
