//! The robot's end of the link.

use std::cell::RefCell;
use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use rcwm_models::interface::Interface;
use rcwm_models::wire::{
    Action, Format, LinkSettings, ObservationFlags, ObservationMut, OwnedObservation, SimulatorLink, Wait,
};

use crate::arrays::{Pixels, append_numbers, array};
use crate::bound::{Bin, ThreadBound};
use crate::errors::{error, input, link as link_error};
use crate::waiting::{released, wait};

#[pyclass(frozen, module = "rcwm._rcwm")]
pub(crate) struct RobotLink {
    #[pyo3(get)]
    robot: Py<PyAny>,
    #[pyo3(get)]
    instance: String,
    format: Arc<Format>,
    end: ThreadBound<RefCell<Option<End>>>,
}

struct End {
    link: SimulatorLink,
    /// What was published last, for a controller that comes later.
    published: Option<OwnedObservation>,
}

impl RobotLink {
    /// Does something with what is open.
    fn with<R>(&self, py: Python<'_>, work: impl FnOnce(&mut End) -> PyResult<R>) -> PyResult<R> {
        let mut end = self.end.get(py)?.borrow_mut();
        work(end.as_mut().ok_or_else(|| error(py, "LinkError", "the link was closed"))?)
    }

    /// One wait; none where there is no answer yet.
    fn attempt(&self, py: Python<'_>, end: &mut End, time: std::time::Duration) -> PyResult<Option<Action>> {
        let failed = |why| link_error(py, &why);
        let (found, events) = released(py, || end.link.wait_action(time)).map_err(failed)?;
        if let (true, Some(published)) = (events.hello, &mut end.published) {
            // It has not seen the present observation.
            published.flags |= ObservationFlags::REPEATED.0;
            end.link.publish_copy(published).map_err(failed)?;
        }
        match found {
            Wait::Message(action) => Ok(Some(action)),
            _ if events.closed => Err(error(py, "PeerClosed", "the controller has closed")),
            _ => Ok(None),
        }
    }
}

#[pymethods]
impl RobotLink {
    #[new]
    fn new(py: Python<'_>, robot: Py<PyAny>, instance: String) -> PyResult<Self> {
        let text: String = robot.call_method0(py, "canonical")?.extract(py)?;
        let interface = Interface::parse(&text).map_err(|why| error(py, "InterfaceError", why))?;
        let (format, settings) = (Format::of(interface), LinkSettings::new(&instance));
        let link =
            released(py, || SimulatorLink::open(settings, &format)).map_err(|why| link_error(py, &why))?;
        let end = ThreadBound::new(RefCell::new(Some(End { link, published: None })), &Bin::new());
        Ok(Self { robot, instance, format, end })
    }

    /// See `_rcwm.pyi`, as for all that follows.
    fn publish(
        &self,
        header: &Bound<'_, PyAny>,
        state: &Bound<'_, PyAny>,
        executed: &Bound<'_, PyAny>,
        images: &Bound<'_, PyDict>,
        masks: &Bound<'_, PyDict>,
    ) -> PyResult<()> {
        let py = header.py();
        self.with(py, |end| {
            let failed = |why| link_error(py, &why);
            let mut slot = end.link.slot().map_err(failed)?;
            let mut observation = slot.edit();
            fill_header(&mut observation, header, self.format.interface().camera.len())?;
            let mut numbers = Vec::new();
            append_numbers(state, "state", observation.state().len(), &mut numbers)?;
            observation.state().copy_from_slice(&numbers);
            numbers.clear();
            append_numbers(executed, "executed action", observation.executed().len(), &mut numbers)?;
            observation.executed().copy_from_slice(&numbers);
            fill_pixels(&mut observation, self.format.interface(), images, masks)?;
            match &mut end.published {
                Some(published) => published.copy(&observation.view()),
                none => *none = Some(observation.view().into()),
            }
            end.link.send(slot).map_err(failed)
        })
    }

    fn wait_action<'py>(&self, py: Python<'py>, timeout_s: f64) -> PyResult<Option<Bound<'py, PyAny>>> {
        let found = wait(py, timeout_s, |time| self.with(py, |end| self.attempt(py, end, time)))?;
        let Some(action) = found else { return Ok(None) };
        let numbers = array(py, &action.action)?;
        py.import("rcwm.messages")?
            .getattr("Answer")?
            .call1((action.answers, numbers, action.source))
            .map(Some)
    }

    #[getter]
    fn misfits(&self, py: Python<'_>) -> PyResult<u64> {
        self.with(py, |end| Ok(end.link.misfits()))
    }

    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let Some(End { link, .. }) = self.end.get(py)?.borrow_mut().take() else { return Ok(()) };
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

fn fill_header(to: &mut ObservationMut<'_>, header: &Bound<'_, PyAny>, cameras: usize) -> PyResult<()> {
    let get = |name: &str| header.getattr(name);
    to.sequence = get("sequence")?.extract()?;
    to.episode = get("episode")?.extract()?;
    to.step = get("step")?.extract()?;
    to.flags = get("flags")?.extract()?;
    to.reward = get("reward")?.extract()?;
    to.scheduled_ns = get("scheduled_ns")?.extract()?;
    to.period_ns = get("period_ns")?.extract()?;
    let captured_ns = get("captured_ns")?.extract()?;
    to.captured_ns[..cameras].fill(captured_ns);
    Ok(())
}

/// Pictures of all cameras, and masks of those that have one and of which one was given.
fn fill_pixels(
    to: &mut ObservationMut<'_>,
    robot: &Interface,
    images: &Bound<'_, PyDict>,
    masks: &Bound<'_, PyDict>,
) -> PyResult<()> {
    let py = images.py();
    let known = |name: &str| robot.camera.iter().any(|camera| camera.name == name);
    let masked = |name: &str| robot.camera.iter().any(|camera| camera.name == name && camera.mask.is_some());
    let (given, given_masks) = (names(images)?, names(masks)?);
    if given.len() != robot.camera.len()
        || !given.iter().all(|name| known(name))
        || !given_masks.iter().all(|name| masked(name))
    {
        let cameras: Vec<_> = robot.camera.iter().map(|camera| camera.name.as_str()).collect();
        return Err(input(
            py,
            format!("pictures {given:?}, masks {given_masks:?}; the robot's cameras are {cameras:?}"),
        ));
    }
    for (at, camera) in robot.camera.iter().enumerate() {
        let name = &camera.name;
        if let Some(picture) = images.get_item(name)? {
            Pixels::of(&picture, "picture", name, &camera.shape)?.copy_to(py, to.image(at))?;
        }
        if let (Some(mask), Some(to)) = (masks.get_item(name)?, to.mask(at)) {
            Pixels::of(&mask, "mask", name, &camera.shape[..2])?.copy_to(py, to)?;
        }
    }
    Ok(())
}

fn names(of: &Bound<'_, PyDict>) -> PyResult<Vec<String>> {
    of.keys().extract()
}
