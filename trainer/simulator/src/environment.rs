//! One Meta-World task, in the embedded interpreter.

use std::marker::PhantomData;

use clap::ValueEnum;
use pyo3::buffer::PyBuffer;
use pyo3::call::PyCallArgs;
use pyo3::prelude::*;
use rcwm_models::tasks::task_id;
use rcwm_models::wire::ObservationMut;
use rcwm_models::{ACTION_LEN, PROPRIOCEPTION_LEN};
use serde::Serialize;

use crate::SimulatorError;
use crate::python::{bridge, python_error};

/// Decisions in the longest episode: Meta-World ends one after 500 physics steps, and each action is executed twice.
pub const STEPS_MAX: u32 = 250;
/// Reward and success come before the proprioception.
const FACTS_LEN: usize = 2 + PROPRIOCEPTION_LEN;

/// A visual disturbance, by strength; the robot's own look and the physics never change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Disturbance {
    /// Meta-World's own look.
    #[default]
    None,
    /// The paper's (Fig. 8): table, rim and floor are of darker wood, navy and mint.
    Paper,
    /// Table, rim and floor have random colours or patterns.
    Surfaces,
    /// Brightness, colour and direction of the light.
    Light,
    /// The camera is moved by up to 2 cm and turned by up to 2 degrees.
    Camera,
    /// Colours and textures of everything but the robot, objects and sky included.
    Textures,
    /// Sky and floor are replaced by random pixels in each picture.
    Noise,
    /// For learning: some of the above but `paper`, together.
    Varied,
}

/// A set of layouts. No two of them share one, whatever seeds and numbers of episodes are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layouts {
    /// To learn from.
    #[default]
    Learning,
    /// To choose settings, checkpoints and recipes on.
    Choosing,
    /// To report on, never to choose or learn on.
    Reporting,
}

/// What to simulate and how to show it.
#[derive(Debug, Clone)]
pub struct EnvironmentSettings {
    /// Name of the task.
    pub task: String,
    /// Which layouts.
    pub layouts: Layouts,
    /// Layouts and disturbances of a set depend on this and the episode's number alone.
    pub seed: u64,
    /// Meta-World's own picture (shadows, reflections, full meshes) instead of the fast one.
    pub faithful: bool,
    /// Whether to render the robot's mask: about half as much work again.
    pub masks: bool,
    /// See [`Disturbance`].
    pub disturb: Disturbance,
}

/// A running task. Its arrays live in Python for as long as this does; nothing is copied but into the message.
pub struct Environment {
    settings: EnvironmentSettings,
    task_id: u32,
    object: Py<PyAny>,
    image: PyBuffer<u8>,
    mask: PyBuffer<u8>,
    /// Reward, success, proprioception.
    facts: PyBuffer<f32>,
    expert_action: PyBuffer<f32>,
    /// A graphics context belongs to the thread that made it.
    not_send: PhantomData<*const ()>,
}

impl Environment {
    /// Loads Meta-World and builds the task; takes a few seconds.
    ///
    /// # Errors
    /// [`SimulatorError::UnknownTask`], or one of the variants about Python.
    pub fn open(settings: EnvironmentSettings) -> Result<Self, SimulatorError> {
        let task_id = task_id(&settings.task)?;
        let module = bridge()?;
        Python::attach(|py| {
            let failed = |error: PyErr| python_error(py, "building the task", &error);
            let EnvironmentSettings { task, layouts, seed, faithful, masks, disturb } = &settings;
            let disturb = disturb.to_possible_value().expect("no variant is hidden");
            let layouts = layouts.to_possible_value().expect("no variant is hidden");
            let arguments = (task, layouts.get_name(), *seed, *faithful, *masks, disturb.get_name());
            let object = module.bind(py).call_method1("Environment", arguments).map_err(failed)?;
            let image = array(&object, "image").map_err(failed)?;
            let mask = array(&object, "mask").map_err(failed)?;
            let facts = array(&object, "facts").map_err(failed)?;
            let expert_action = array(&object, "expert_action").map_err(failed)?;
            let object = object.unbind();
            Ok(Self { task_id, object, image, mask, facts, expert_action, settings, not_send: PhantomData })
        })
    }

    /// What it was built with.
    #[must_use]
    pub fn settings(&self) -> &EnvironmentSettings {
        &self.settings
    }

    /// Starts an episode with the layout of this number.
    ///
    /// # Errors
    /// [`SimulatorError::Python`].
    pub fn reset(&self, episode: u64) -> Result<(), SimulatorError> {
        self.call("starting an episode", "reset", (episode,))
    }

    /// Executes one action, each component in [-1, 1], for two physics steps.
    ///
    /// # Errors
    /// [`SimulatorError::Python`]; also after [`STEPS_MAX`] steps without a reset.
    pub fn step(&self, action: [f32; ACTION_LEN]) -> Result<(), SimulatorError> {
        let [x, y, z, grip] = action;
        self.call("executing an action", "step", (x, y, z, grip))
    }

    /// What the task's scripted expert would do now.
    ///
    /// # Errors
    /// [`SimulatorError::Python`].
    pub fn expert_action(&self) -> Result<[f32; ACTION_LEN], SimulatorError> {
        self.call("asking the expert", "ask_expert", ())?;
        let mut action = [0.0; ACTION_LEN];
        Python::attach(|py| {
            let copied = self.expert_action.copy_to_slice(py, &mut action);
            copied.map_err(|error| python_error(py, "reading the expert's action", &error))
        })?;
        Ok(action)
    }

    /// Writes reward, proprioception, image and, where rendered, mask into a message; returns whether the task counts as
    /// solved. Everything else in the message is left alone.
    ///
    /// # Errors
    /// [`SimulatorError::Python`].
    pub fn write_to(&self, observation: &mut ObservationMut<'_>) -> Result<bool, SimulatorError> {
        let mut facts = [0.0_f32; FACTS_LEN];
        Python::attach(|py| {
            self.facts.copy_to_slice(py, &mut facts)?;
            if self.settings.masks
                && let Some(mask) = observation.mask(0)
            {
                self.mask.copy_to_slice(py, mask)?;
            }
            self.image.copy_to_slice(py, observation.image(0))
        })
        .map_err(|error| Python::attach(|py| python_error(py, "reading the picture", &error)))?;
        let [reward, success, proprioception @ ..] = facts;
        observation.task = self.task_id;
        observation.reward = reward;
        observation.state().copy_from_slice(&proprioception);
        Ok(success > 0.0)
    }

    fn call<A>(&self, doing: &'static str, method: &str, arguments: A) -> Result<(), SimulatorError>
    where
        A: for<'py> PyCallArgs<'py>,
    {
        Python::attach(|py| {
            let called = self.object.bind(py).call_method1(method, arguments);
            called.map(drop).map_err(|error| python_error(py, doing, &error))
        })
    }
}

impl Drop for Environment {
    fn drop(&mut self) {
        // The graphics context must be freed while it is current; a failure leaves it to the end of the process.
        let _ = self.call("closing the task", "close", ());
    }
}

fn array<T: pyo3::buffer::Element>(object: &Bound<'_, PyAny>, name: &str) -> PyResult<PyBuffer<T>> {
    PyBuffer::get(&object.getattr(name)?)
}

/// Names of the tasks that the installed Meta-World has, sorted.
///
/// # Errors
/// One of the variants about Python.
pub fn installed_tasks() -> Result<Vec<String>, SimulatorError> {
    let module = bridge()?;
    Python::attach(|py| {
        let names = module.bind(py).call_method0("task_names").and_then(|names| names.extract());
        names.map_err(|error| python_error(py, "listing the tasks", &error))
    })
}
