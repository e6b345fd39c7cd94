//! Learns the Robo-Centric World Model and exports it.
//!
//! | module | holds |
//! | --- | --- |
//! | [`ops`] | differentiable primitives |
//! | [`model`] | RCWM and the vanilla baseline |
//! | [`learning`] | losses, gradients and updates of the world model |
//! | [`behaviour`] | imagination with the actor, returns, actor and critic updates |
//! | [`acting`] | the policy in simulators while it learns |
//! | [`cloning`] | the actor from demonstrations |
//! | [`replay`] | experience in memory, batches drawn from it |
//! | [`simulators`] | Meta-World processes: started, joined, recorded |
//! | [`training`] | runs: phases, metrics, checkpoints, resuming |
//! | [`spectrum`] | singular values and effective ranks of weights |
//! | [`checkpoint`] | weights and settings on disk |
//! | [`import`] | checkpoints of other implementations |
//! | [`export`] | the bundle that a runtime deploys |
//! | [`parity`] | our numbers against the authors' |
//! | [`evaluation`] | what a model can do: open loop, robot dynamics, success |
//! | [`report`] | what was measured, kept in parts and drawn as one page |
//! | [`plots`] | charts, films and text as pictures |
//!
//! This crate never depends on tract or pyo3.

pub mod acting;
pub mod behaviour;
pub mod checkpoint;
pub mod cloning;
pub mod evaluation;
pub mod export;
pub mod gpu;
pub mod import;
pub mod learning;
pub mod model;
pub mod ops;
pub mod parity;
pub mod plots;
pub mod replay;
pub mod report;
pub mod simulators;
pub mod spectrum;
pub mod training;
