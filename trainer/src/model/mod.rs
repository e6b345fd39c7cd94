//! RCWM and the vanilla baseline, forward.
//!
//! | letter | meaning |
//! | --- | --- |
//! | B, T | rows of a batch, steps of a sequence |
//! | L | steps of an imagination |
//! | N | any number of images (B * T) |
//! | n, m | categoricals of z, classes of each |
//! | d | width of the deterministic state h |
//! | c | cnn depth: channels after the first convolution |
//! | E | width of an image's embedding |
//! | S, C | side of an image, cameras |
//! | k | rows the interaction model makes of the robot's h, d / m |
//!
//! Equation numbers are the paper's. Superscript R is the robot, E the environment. The first action of a pair `(a_{t-1}, o_t)` is the
//! one that led to the image, as in Dreamer's replay.
//!
//! | file | holds |
//! | --- | --- |
//! | `parameters`, `init` | named parameters, where they come from, how they start |
//! | `layers` | linear, dense block, two-layer perceptron |
//! | `encoder`, `decoder` | images in, images and masks out |
//! | `measured` | what the robot measures of itself, in and out |
//! | `branch` | recurrent cell, prior, posterior, initial state: robot and environment alike |
//! | `interaction` | what the robot does to the environment |
//! | `latent` | states, beginnings of episodes, sampling |
//! | `rcwm`, `vanilla`, `world` | the two world models and what they have in common |
//! | `heads`, `agent` | reward, continuation, actor, critic; everything together |

pub mod agent;
mod batch;
pub mod branch;
pub mod decoder;
pub mod encoder;
pub mod heads;
pub mod init;
pub mod interaction;
pub mod latent;
pub mod layers;
pub mod measured;
pub mod parameters;
pub mod rcwm;
pub mod vanilla;
pub mod world;
