//! The contract between simulator, trainer and runtime.
//!
//! | module | holds |
//! | --- | --- |
//! | [`settings`] | the sizes of a model, presets `debug`, `small`, `paper`, TOML and dotted overrides |
//! | [`tasks`] | Meta-World's task names and their numbers on the wire |
//! | [`interface`] | what a robot offers and a policy needs: names, units, limits, a safe action |
//! | [`wire`] | the messages between simulator and controller and the shared-memory link that carries them |
//! | [`bundle`] | the folder a trainer exports and a runtime deploys |
//! | [`onnx`] | reading and writing ONNX files |
//! | [`episode`] | recorded episodes as Dreamer's `.npz` files |
//! | [`tensors`] | named arrays in safetensors files |
//! | [`errors`] | errors as one line for people |
//! | [`files`] | atomic writes, checksums, capped reads |
//! | [`help`] | the examples of a help text |
//! | [`lock`] | one writer a folder |
//! | [`machine`] | what a measurement was made on |
//! | `picture` | PNG files (feature `pictures`) |
//! | [`programs`] | where the programs that start one another are |
//! | [`progress`] | how far a long work is, on a terminal or by lines |
//! | [`terminal`] | printing that survives a closed pipe and a full disk; lines of progress without a terminal |
//!
//! This crate never depends on candle, tract or pyo3.

pub mod bundle;
pub mod episode;
pub mod errors;
pub mod files;
pub mod help;
pub mod interface;
pub mod lock;
pub mod machine;
pub mod onnx;
#[cfg(feature = "pictures")]
pub mod picture;
pub mod programs;
pub mod progress;
pub mod settings;
pub mod tasks;
pub mod tensors;
pub mod terminal;
pub mod wire;

/// Side of the images of Meta-World's arm and of the presets' encoder, in pixels.
pub const IMAGE_SIDE: usize = 64;
/// Colour channels of an image.
pub const IMAGE_CHANNELS: usize = 3;
/// Bytes of one image, rows first, channels last.
pub const IMAGE_BYTES: usize = IMAGE_SIDE * IMAGE_SIDE * IMAGE_CHANNELS;
/// Bytes of one robot mask (0 or 255 per pixel).
pub const MASK_BYTES: usize = IMAGE_SIDE * IMAGE_SIDE;
/// Length of an action of Meta-World's arm: three translations of the hand and the gripper, each in [-1, 1].
pub const ACTION_LEN: usize = 4;
/// Length of the measured state of Meta-World's arm: 9 joint positions, then 9 joint velocities.
pub const PROPRIOCEPTION_LEN: usize = 18;
