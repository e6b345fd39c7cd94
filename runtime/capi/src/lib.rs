//! The policy and the robot's end of the link for C and C++: `librcwm`.
//!
//! | module | holds |
//! | --- | --- |
//! | [`code`] | how a call ended: a code, and a text of the calling thread |
//! | [`border`] | what every call does with what crosses: pointers checked, panics caught, one thread at a time |
//! | [`policy`] | a bundle that decides |
//! | [`robot`] | the robot's end of the link, served by callbacks or by a loop of the program's own |
//!
//! What a user reads stands in `include/rcwm.h`, which `cbindgen` makes of these files: doc comments of what is exported are written for
//! C. This crate never links candle or Python.

#![expect(clippy::missing_safety_doc, reason = "what holds for all pointers is said once, in the header")]

mod border;
mod code;
mod policy;
mod robot;

pub use code::*;
pub use policy::*;
pub use robot::*;
