//! A bundle inside a Python program.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use pyo3::exceptions::{PyIndexError, PyKeyError, PyTypeError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};
use rcwm_models::bundle::{Bundle, Manifest};
use rcwm_models::interface::Interface;
use rcwm_models::wire::ActionValues;
use rcwm_runtime::engine::EngineKind;
use rcwm_runtime::policy::{ActionLimits, InputReader, STAGES, Sampling, Surprise};
use rcwm_runtime::{EngineSettings, PolicyError};

use crate::arrays::{Pixels, action, append_numbers, array};
use crate::errors::{error, input, policy as policy_error};

/// One of the bundle's inputs, in their order.
enum Input {
    Camera { name: Py<PyString>, shape: [usize; 3] },
    State { name: Py<PyString>, numbers: usize },
}

impl Input {
    fn of(py: Python<'_>, name: &str, interface: &Interface) -> Self {
        let key = PyString::intern(py, name).unbind();
        match interface.camera.iter().find(|camera| camera.name == name) {
            Some(camera) => Self::Camera { name: key, shape: camera.shape },
            None => {
                let numbers = interface.state_range(name).map_or(0, |range| range.len());
                Self::State { name: key, numbers }
            }
        }
    }
}

/// What a call changes.
struct Core {
    policy: rcwm_runtime::Policy,
    reader: InputReader,
}

/// May be used from any thread: one call after the other.
#[pyclass(frozen, module = "rcwm._rcwm")]
pub(crate) struct Policy {
    core: Mutex<Option<Core>>,
    manifest: Manifest,
    bundle: PathBuf,
    inputs: Vec<Input>,
    limits: ActionLimits,
}

impl Policy {
    /// What it needs of a robot: its interface, and which of it are its inputs.
    pub(crate) fn needs(&self) -> (Interface, Vec<String>) {
        (self.manifest.interface.clone(), self.manifest.policy.inputs.clone())
    }

    /// Does something without the interpreter's lock.
    fn call<R: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut Core) -> Result<R, PolicyError> + Send,
    ) -> PyResult<R> {
        let done = py.detach(|| {
            // Who panicked has left it between two states.
            let mut core =
                self.core.lock().map_err(|_| "the policy failed in an earlier call; load it again")?;
            Ok(work(core.as_mut().ok_or("the policy was closed")?))
        });
        done.map_err(|text: &str| error(py, "PolicyError", text))?.map_err(|why| policy_error(py, &why))
    }

    fn executed(&self, given: Option<&Bound<'_, PyAny>>) -> PyResult<Option<ActionValues>> {
        given.map(|given| action(given, "executed action", self.limits.numbers())).transpose()
    }

    fn given<'py>(&self, inputs: &Bound<'py, PyAny>, name: &Py<PyString>) -> PyResult<Bound<'py, PyAny>> {
        let py = inputs.py();
        inputs.get_item(name).map_err(|why| {
            let expected = self.manifest.policy.inputs.join(", ");
            if why.is_instance_of::<PyKeyError>(py) {
                input(py, format!("input {name} is missing; the policy reads {expected}"))
            } else if why.is_instance_of::<PyTypeError>(py) || why.is_instance_of::<PyIndexError>(py) {
                let found = inputs.get_type();
                input(py, format!("inputs: {found}; expected a dictionary of {expected}"))
            } else {
                why
            }
        })
    }
}

#[pymethods]
impl Policy {
    #[new]
    #[pyo3(signature = (bundle, *, threads=1, sample=None))]
    fn new(py: Python<'_>, bundle: PathBuf, threads: u16, sample: Option<u64>) -> PyResult<Self> {
        if !(1..=2).contains(&threads) {
            return Err(input(py, format!("threads = {threads}: expected 1 or 2")));
        }
        let engine = EngineSettings::single_threaded(EngineKind::Tract).with_threads(threads.into());
        let sampling = sample.map_or(Sampling::Mode, |seed| Sampling::Sample { seed });
        let loaded = py.detach(|| {
            let policy = rcwm_runtime::Policy::new(&Bundle::open(&bundle)?, engine, sampling)?;
            let reader = InputReader::of(policy.manifest());
            Ok(Core { policy, reader })
        });
        let core = loaded.map_err(|why| policy_error(py, &why))?;
        let (manifest, limits) = (core.policy.manifest().clone(), core.policy.limits());
        let inputs = manifest.policy.inputs.iter();
        let inputs = inputs.map(|name| Input::of(py, name, &manifest.interface)).collect();
        Ok(Self { core: Mutex::new(Some(core)), manifest, bundle, inputs, limits })
    }

    /// See `_rcwm.pyi`, as for all that follows.
    #[pyo3(signature = (inputs, executed=None))]
    fn observe(&self, inputs: &Bound<'_, PyAny>, executed: Option<&Bound<'_, PyAny>>) -> PyResult<Decision> {
        let (mut pictures, mut state) = (Vec::with_capacity(self.inputs.len()), Vec::new());
        for wanted in &self.inputs {
            match wanted {
                Input::Camera { name, shape } => {
                    let given = self.given(inputs, name)?;
                    pictures.push(Pixels::of(&given, "picture", name, shape)?.contiguous(&given)?);
                }
                Input::State { name, numbers } => {
                    append_numbers(
                        &self.given(inputs, name)?,
                        format_args!("state {name}"),
                        *numbers,
                        &mut state,
                    )?;
                }
            }
        }
        let executed = self.executed(executed)?;
        self.call(inputs.py(), |Core { policy, reader }| {
            let pictures = pictures.iter().map(Pixels::bytes);
            let inputs = reader.arrange(pictures, std::iter::once(state.as_slice()));
            policy.observe(inputs, executed.as_ref())
        })
        .map(Decision)
    }

    #[pyo3(signature = (executed=None))]
    fn work_ahead(&self, py: Python<'_>, executed: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let executed = self.executed(executed)?;
        self.call(py, |core| core.policy.work_ahead(executed.as_ref()))
    }

    fn imagine(&self, py: Python<'_>, executed: &Bound<'_, PyAny>) -> PyResult<Decision> {
        let executed = action(executed, "executed action", self.limits.numbers())?;
        self.call(py, |core| core.policy.imagine(&executed)).map(Decision)
    }

    fn warm_caches(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, |core| {
            core.policy.warm_caches();
            Ok(())
        })
    }

    #[getter]
    fn bundle(&self) -> &PathBuf {
        &self.bundle
    }

    #[getter]
    fn kind(&self) -> String {
        self.manifest.kind.to_string()
    }

    #[getter]
    fn imagines(&self) -> bool {
        self.manifest.model.is_some()
    }

    #[getter]
    fn interface<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        py.import("rcwm.interface")?.getattr("parse")?.call1((self.manifest.interface.canonical(),))
    }

    #[getter]
    fn inputs(&self) -> Vec<&str> {
        self.manifest.policy.inputs.iter().map(String::as_str).collect()
    }

    #[getter]
    fn low<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, &self.limits.low)
    }

    #[getter]
    fn high<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, &self.limits.high)
    }

    fn close(&self, py: Python<'_>) {
        let core = py.detach(|| self.core.lock().unwrap_or_else(PoisonError::into_inner).take());
        drop(core);
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_why))]
    fn __exit__(&self, py: Python<'_>, _why: &Bound<'_, PyAny>) {
        self.close(py);
    }

    fn __repr__(&self) -> String {
        let Manifest { kind, policy, .. } = &self.manifest;
        format!("Policy({}: {kind}, reads {})", self.bundle.display(), policy.inputs.join(", "))
    }
}

#[pyclass(frozen, module = "rcwm._rcwm")]
pub(crate) struct Decision(rcwm_runtime::Decision);

#[pymethods]
impl Decision {
    #[getter]
    fn action<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, &self.0.action)
    }

    #[getter]
    fn mean<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, &self.0.mean)
    }

    #[getter]
    fn std<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, &self.0.std)
    }

    #[getter]
    fn surprise<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let surprise = PyDict::new(py);
        match self.0.surprise {
            Some(Surprise::Rcwm { robot, environment }) => {
                surprise.set_item("robot", robot)?;
                surprise.set_item("environment", environment)?;
            }
            Some(Surprise::Dreamer(dynamics)) => surprise.set_item("dynamics", dynamics)?,
            None => {}
        }
        Ok(surprise)
    }

    #[getter]
    fn stage_ns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let stages = PyDict::new(py);
        for (stage, ns) in STAGES.iter().zip(self.0.stage_ns) {
            stages.set_item(stage.as_str(), ns)?;
        }
        Ok(stages)
    }

    #[getter]
    fn recomputed(&self) -> bool {
        self.0.recomputed
    }

    #[getter]
    fn helper_late(&self) -> bool {
        self.0.helper_late
    }

    fn __repr__(&self) -> String {
        format!("Decision(action={:?}, surprise={:?})", self.0.action, self.0.surprise.map(<[f32; 2]>::from))
    }
}
