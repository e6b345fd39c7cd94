//! Learns the Robo-Centric World Model and exports it.
//!
//! | module | holds |
//! | --- | --- |
//! | [`ops`] | differentiable primitives |
//! | [`model`] | RCWM and the vanilla baseline |
//! | [`behaviour`] | imagination with the actor, returns |
//! | [`checkpoint`] | weights and settings on disk |
//! | [`export`] | the bundle that a runtime deploys |
//! | [`parity`] | our numbers against the authors' |
//!
//! This crate never depends on tract or pyo3.

pub mod behaviour;
pub mod checkpoint;
pub mod export;
pub mod model;
pub mod ops;
pub mod parity;
