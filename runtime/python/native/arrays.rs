//! Numpy's arrays in and out, by the buffer protocol: what else offers it, or `__array__`, is as good.

use std::fmt::Display;

use pyo3::buffer::{PyBuffer, PyUntypedBuffer};
use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyByteArray, PyDict};
use rcwm_models::wire::ActionValues;

use crate::errors::input;

/// A picture's or a mask's bytes.
pub(crate) struct Pixels(PyBuffer<u8>);

impl Pixels {
    /// Looks at what was given as the `kind` (picture, mask) of this name: u8 of the shape. Raises `InputError`.
    pub(crate) fn of(
        given: &Bound<'_, PyAny>,
        kind: &str,
        name: impl Display,
        shape: &[usize],
    ) -> PyResult<Self> {
        let py = given.py();
        let given = with_buffer(given)?;
        let misfit = || {
            let found = given.getattr("shape").and_then(|shape| shape.extract::<Vec<usize>>());
            let dtype = given.getattr("dtype").map_or_else(|_| String::new(), |dtype| dtype.to_string());
            let found =
                found.map_or_else(|_| given.get_type().to_string(), |shape| format!("{dtype} {shape:?}"));
            input(py, format!("{kind} {name}: {found}; expected uint8 {shape:?}"))
        };
        let buffer = PyUntypedBuffer::get(&given).map_err(|_| misfit())?;
        if buffer.format().to_bytes() != b"B" || buffer.shape() != shape {
            return Err(misfit());
        }
        Ok(Self(buffer.into_typed()?))
    }

    /// Where they lie one after another in memory; else they are copied.
    pub(crate) fn contiguous(self, given: &Bound<'_, PyAny>) -> PyResult<Self> {
        if self.0.is_c_contiguous() {
            return Ok(self);
        }
        Self::of_contiguous(&numpy(given.py())?.call_method1("ascontiguousarray", (given,))?)
    }

    fn of_contiguous(array: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self(PyBuffer::get(array)?))
    }

    /// The bytes as they lie there; none where they do not lie one after another.
    ///
    /// A thread of Python's that writes to them meanwhile makes them a mixture of pictures, as a camera's driver does that writes to memory
    /// while it is read. Every byte is a number of a pixel.
    pub(crate) fn bytes(&self) -> &[u8] {
        // SAFETY: the buffer is held, and Python keeps its memory until it is released.
        self.0.as_slice_ptr().map_or(&[], |bytes| unsafe { bytes.as_ref() })
    }

    /// Writes them one after another.
    pub(crate) fn copy_to(&self, py: Python<'_>, to: &mut [u8]) -> PyResult<()> {
        self.0.copy_to_slice(py, to)
    }
}

/// `given`, or the array that it says it is.
fn with_buffer<'py>(given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: a borrowed object of a held reference.
    if unsafe { pyo3::ffi::PyObject_CheckBuffer(given.as_ptr()) } == 1 {
        return Ok(given.clone());
    }
    numpy(given.py())?.call_method1("asarray", (given,))
}

/// Appends `count` finite numbers that were given as `what`: an array, or anything that numpy makes one of. Raises `InputError`.
pub(crate) fn append_numbers(
    given: &Bound<'_, PyAny>,
    what: impl Display,
    count: usize,
    numbers: &mut Vec<f32>,
) -> PyResult<()> {
    let py = given.py();
    let from = numbers.len();
    let buffer = match PyBuffer::<f32>::get(given) {
        Ok(buffer) => buffer,
        Err(_) => {
            let options = PyDict::new(py);
            options.set_item("dtype", "float32")?;
            let array = numpy(py)?.call_method("asarray", (given,), Some(&options));
            // What numpy says of it; Ctrl-C is none of that.
            let array = array.map_err(|error| match error.is_instance_of::<PyException>(py) {
                true => input(py, format!("{what}: expected {count} numbers ({})", error.value(py))),
                false => error,
            })?;
            PyBuffer::get(&array)?
        }
    };
    if buffer.item_count() != count {
        return Err(input(py, format!("{what}: {} numbers, expected {count}", buffer.item_count())));
    }
    numbers.resize(from + count, 0.0);
    buffer.copy_to_slice(py, &mut numbers[from..])?;
    match numbers[from..].iter().all(|x| x.is_finite()) {
        true => Ok(()),
        false => Err(input(py, format!("{what}: {:?} is not finite", &numbers[from..]))),
    }
}

/// An action of `count` finite numbers. Raises `InputError`.
pub(crate) fn action(given: &Bound<'_, PyAny>, what: impl Display, count: usize) -> PyResult<ActionValues> {
    let mut numbers = Vec::with_capacity(count);
    append_numbers(given, what, count, &mut numbers)?;
    Ok(numbers.into_iter().collect())
}

/// A new array [n] f32.
pub(crate) fn array<'py>(py: Python<'py>, numbers: &[f32]) -> PyResult<Bound<'py, PyAny>> {
    view(&PyByteArray::new(py, bytemuck::cast_slice(numbers)), "f4", numbers.len(), 0)
}

/// Numbers of a kind (`u1`, `f4`) that lie in the memory of `owner`, which they keep alive: [n].
pub(crate) fn view<'py>(
    owner: &Bound<'py, PyAny>,
    dtype: &str,
    count: usize,
    offset: usize,
) -> PyResult<Bound<'py, PyAny>> {
    static FROMBUFFER: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let py = owner.py();
    FROMBUFFER.import(py, "numpy", "frombuffer")?.call1((owner, dtype, count, offset))
}

fn numpy(py: Python<'_>) -> PyResult<Bound<'_, PyModule>> {
    py.import("numpy")
}
