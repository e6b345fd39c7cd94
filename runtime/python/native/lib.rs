//! The native module of the Python package `rcwm`: the policy, and all ends of the link.
//!
//! | module | holds |
//! | --- | --- |
//! | [`policy`] | `Policy`, `Decision`: a bundle inside a Python program |
//! | [`robot`] | `RobotLink`: the robot's end of the link |
//! | [`controller`] | `ControllerLink`, `ObserverLink`: the controller's end, and whoever listens in |
//! | [`observation`] | `Observation`: what was received, as arrays that lie in shared memory |
//! | [`arrays`] | numpy's arrays in and out, by the buffer protocol |
//! | [`bound`] | what only the thread may touch that made it |
//! | [`waiting`] | waits that let other threads run and that Ctrl-C ends |
//! | [`errors`] | the package's exceptions |
//!
//! The interpreter's lock is released while a policy computes and while a link waits. Types and texts for users are in
//! `src/rcwm/_rcwm.pyi`.

mod arrays;
mod bound;
mod controller;
mod errors;
mod observation;
mod policy;
mod robot;
mod waiting;

use pyo3::prelude::*;

#[pymodule]
mod _rcwm {
    #[pymodule_export]
    use crate::controller::{ControllerLink, ObserverLink};
    #[pymodule_export]
    use crate::observation::Observation;
    #[pymodule_export]
    use crate::policy::{Decision, Policy};
    #[pymodule_export]
    use crate::robot::RobotLink;
}
