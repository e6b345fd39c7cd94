//! Deploys a bundle (RCWM, DreamerV3 or any ONNX policy) as a controller.
//!
//! | module | holds |
//! | --- | --- |
//! | [`engine`] | what runs an ONNX part: tract, or ONNX Runtime (feature `ort`) |
//! | [`mod@compile`] | the exported parts as one graph, its hot nodes fused, cut where the image comes in |
//! | [`operators`] | our operators in tract, which the fused nodes become |
//! | [`policy`] | one tick: observation and executed action in, action out; carries z and h of every branch, or what the graph carries |
//! | [`controller`] | the loop over shared memory: state machine, fallback, action limits, counters |
//! | [`pacing`] | when the next observation is due, how to wait for it, when it counts as late |
//! | [`realtime`] | what Linux grants a thread that must be on time |
//! | [`telemetry`] | latency histograms, one per stage |
//! | [`swap`] | another policy in place of the running one |
//! | [`record`] | one record a tick, from the loop to the thread that writes |
//! | [`mod@log`] | every tick of a run in a file |
//! | [`snapshots`] | a JSON line every so often |
//! | [`verify`] | a bundle against its golden values |
//!
//! A policy without shared memory:
//!
//! ```no_run
//! use rcwm_runtime::{EngineSettings, Policy};
//!
//! let mut policy = Policy::load("models/bundles/hammer".as_ref(), EngineSettings::tract())?;
//! let image = vec![0_u8; rcwm_models::IMAGE_BYTES]; // 64 x 64 x 3, upright, RGB
//! let mut executed = None; // nothing yet: an episode starts
//! for _ in 0..250 {
//!     let decision = policy.observe(&image, executed.as_ref())?;
//!     executed = Some(decision.action); // send it to the robot; report what was really executed
//!     policy.work_ahead(executed.as_ref())?; // in the idle time: what the next tick needs besides the image
//! }
//! # Ok::<(), rcwm_runtime::PolicyError>(())
//! ```
//!
//! In a program of its own that has a rate to keep: [`realtime::keep_memory`] first thing in `main`, [`Policy::warm_caches`] shortly before an image comes.
//!
//! This crate never links candle or Python.

pub mod cli;
pub mod compile;
pub mod controller;
pub mod engine;
pub mod log;
pub mod operators;
pub mod pacing;
pub mod policy;
pub mod realtime;
pub mod record;
pub mod snapshots;
pub mod swap;
pub mod telemetry;
pub mod verify;

pub use engine::{EngineError, EngineKind, EngineSettings};
pub use policy::{Decision, Policy, PolicyError};
