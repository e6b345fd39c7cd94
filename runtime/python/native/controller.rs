//! The controller's end of the link, and the end of whoever listens in.

use std::cell::RefCell;
use std::sync::Arc;
use std::time::Duration;

use pyo3::prelude::*;
use rcwm_models::interface::mismatches;
use rcwm_models::wire::{
    self, Action, ActionSource, Format, LinkError, LinkSettings, ObservationSample, Wait,
};

use crate::arrays::action;
use crate::bound::{Bin, ThreadBound};
use crate::errors::{error, input, link as link_error};
use crate::observation::Observation;
use crate::policy::Policy;
use crate::waiting::{released, wait};

/// What both ends do that receive observations.
trait Receives {
    fn robot(&self, time: Duration) -> Result<Option<Arc<Format>>, LinkError>;
    fn observation(&self, time: Duration) -> Result<Wait<ObservationSample>, LinkError>;
}

impl Receives for wire::ControllerLink {
    fn robot(&self, time: Duration) -> Result<Option<Arc<Format>>, LinkError> {
        self.wait_robot(time)
    }

    fn observation(&self, time: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        self.wait_observation(time)
    }
}

impl Receives for wire::ObserverLink {
    fn robot(&self, time: Duration) -> Result<Option<Arc<Format>>, LinkError> {
        self.wait_robot(time)
    }

    fn observation(&self, time: Duration) -> Result<Wait<ObservationSample>, LinkError> {
        self.wait_observation(time)
    }
}

/// An open link of one thread, and its observations that other threads have dropped.
struct End<L> {
    link: ThreadBound<RefCell<Option<L>>>,
    dropped: Bin<ObservationSample>,
}

impl<L: Receives> End<L> {
    fn open(py: Python<'_>, open: impl FnOnce() -> Result<L, LinkError>) -> PyResult<Self> {
        let link = released(py, open).map_err(|why| link_error(py, &why))?;
        Ok(Self { link: ThreadBound::new(RefCell::new(Some(link)), &Bin::new()), dropped: Bin::new() })
    }

    fn with<R>(&self, py: Python<'_>, work: impl FnOnce(&mut L) -> PyResult<R>) -> PyResult<R> {
        let mut link = self.link.get(py)?.borrow_mut();
        work(link.as_mut().ok_or_else(|| error(py, "LinkError", "the link was closed"))?)
    }

    fn wait_robot<'py>(&self, py: Python<'py>, timeout_s: f64) -> PyResult<Option<Bound<'py, PyAny>>> {
        let found = wait(py, timeout_s, |time| {
            self.with(py, |link| released(py, || link.robot(time)).map_err(|why| link_error(py, &why)))
        })?;
        found.map(|format| parsed(py, &format.interface().canonical())).transpose()
    }

    fn observe(&self, py: Python<'_>, timeout_s: f64) -> PyResult<Option<Observation>> {
        wait(py, timeout_s, |time| {
            self.with(py, |link| {
                // SAFETY: `with` has made sure of the thread.
                unsafe { self.dropped.empty() };
                match released(py, || link.observation(time)).map_err(|why| link_error(py, &why))? {
                    Wait::Message(sample) => Ok(Some(Observation::of(sample, &self.dropped))),
                    Wait::TimedOut => Ok(None),
                    Wait::Closed => Err(error(py, "PeerClosed", "the robot has closed")),
                }
            })
        })
    }

    /// What was open.
    fn close(&self, py: Python<'_>) -> PyResult<Option<L>> {
        let link = self.link.get(py)?.borrow_mut().take();
        // SAFETY: `get` has made sure of the thread.
        unsafe { self.dropped.empty() };
        Ok(link)
    }
}

/// An interface as Python has it.
pub(crate) fn parsed<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("rcwm.interface")?.getattr("parse")?.call1((text,))
}

#[pyclass(frozen, module = "rcwm._rcwm")]
pub(crate) struct ControllerLink {
    #[pyo3(get)]
    instance: String,
    end: End<wire::ControllerLink>,
}

#[pymethods]
impl ControllerLink {
    #[new]
    #[pyo3(signature = (instance, policy=None))]
    fn new(py: Python<'_>, instance: String, policy: Option<&Bound<'_, Policy>>) -> PyResult<Self> {
        let needed = policy.map(|policy| policy.get().needs());
        let needs = move |robot: &_| match &needed {
            None => Vec::new(),
            Some((interface, inputs)) => {
                let inputs: Vec<_> = inputs.iter().map(String::as_str).collect();
                mismatches(interface, &inputs, robot)
            }
        };
        let settings = LinkSettings::new(&instance);
        Ok(Self { end: End::open(py, || wire::ControllerLink::open(settings, needs))?, instance })
    }

    fn wait_robot<'py>(&self, py: Python<'py>, timeout_s: f64) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.end.wait_robot(py, timeout_s)
    }

    fn observe(&self, py: Python<'_>, timeout_s: f64) -> PyResult<Option<Observation>> {
        self.end.observe(py, timeout_s)
    }

    #[pyo3(signature = (answers, numbers, source=0))]
    fn act(&self, py: Python<'_>, answers: u64, numbers: &Bound<'_, PyAny>, source: u32) -> PyResult<()> {
        if ActionSource::from_wire(source).is_none() {
            return Err(input(
                py,
                format!("source {source}: expected 0 (policy), 1 (imagined) or 2 (fallback)"),
            ));
        }
        self.end.with(py, |link| {
            let nobody = || error(py, "LinkError", "there was no robot yet");
            let limits = link.format().ok_or_else(nobody)?.interface().numbers();
            let mut action = action(numbers, "action", limits.len())?;
            action.iter_mut().zip(&limits).for_each(|(x, limit)| *x = x.clamp(limit.low, limit.high));
            let sent = link.send(&Action { answers, published_ns: 0, source, action });
            sent.map(drop).map_err(|why| link_error(py, &why))
        })
    }

    fn forget_robot(&self, py: Python<'_>) -> PyResult<()> {
        self.end.with(py, |link| {
            link.forget_robot();
            Ok(())
        })
    }

    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let Some(link) = self.end.close(py)? else { return Ok(()) };
        link.close().map_err(|why| link_error(py, &why))
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_why))]
    fn __exit__(&self, py: Python<'_>, _why: &Bound<'_, PyAny>) -> PyResult<()> {
        self.close(py)
    }
}

#[pyclass(frozen, module = "rcwm._rcwm")]
pub(crate) struct ObserverLink {
    #[pyo3(get)]
    instance: String,
    end: End<wire::ObserverLink>,
}

#[pymethods]
impl ObserverLink {
    #[new]
    fn new(py: Python<'_>, instance: String) -> PyResult<Self> {
        let settings = LinkSettings::new(&instance);
        Ok(Self { end: End::open(py, || wire::ObserverLink::open(settings))?, instance })
    }

    fn wait_robot<'py>(&self, py: Python<'py>, timeout_s: f64) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.end.wait_robot(py, timeout_s)
    }

    fn observe(&self, py: Python<'_>, timeout_s: f64) -> PyResult<Option<Observation>> {
        self.end.observe(py, timeout_s)
    }

    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.end.close(py).map(drop)
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_why))]
    fn __exit__(&self, py: Python<'_>, _why: &Bound<'_, PyAny>) -> PyResult<()> {
        self.close(py)
    }
}
