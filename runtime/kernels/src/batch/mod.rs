//! The arithmetic of an update: batches of rows, forward and backward, as plain functions on slices.
//!
//! Rows are the unit: `[rows, width]`, row after row. Backward functions compute what they need of the forward pass again from its
//! inputs, where that is cheaper than to have kept it: a few flops a number against a trip to memory.

pub mod attention;
pub mod categorical;
pub mod conv;
pub mod gates;
pub mod math;
pub mod norm;
mod norm_parameters;
pub mod norm_vector;
pub mod picture;
pub mod tile;
