//! What is looked at off the robot of what runs on a robot.
//!
//! | module | holds |
//! | --- | --- |
//! | [`mod@log`] | a logged run again, bit for bit; its times; its episodes |
//! | [`film`] | films and strips of a logged run |
//! | [`mod@mcap`] | a logged run for Foxglove, rerun and ROS 2 |
//! | [`plot`] | latency by percentile as a picture |
//! | [`bundle`] | a bundle of any library's ONNX policy |
//! | [`watch`] | a robot and its controller while they run |
//! | [`inspect`] | what a bundle holds and what a tick costs |
//! | [`mod@bench`] | the tick's latency on this machine, engines interleaved |
//!
//! This crate never links candle or Python.

pub mod bench;
pub mod bundle;
pub mod cli;
pub mod film;
pub mod inspect;
pub mod log;
pub mod mcap;
pub mod plot;
pub mod watch;
