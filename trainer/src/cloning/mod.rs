//! Behaviour cloning: the actor learns from demonstrations, on the posterior states that the world model has of them.
//!
//! Nouns: an **example** is a state s_t of a demonstration and the action that was taken in it. In Dreamer's convention `action[t]`
//! led to `image[t]`: the action taken at t is `action[t + 1]`, and the last step of an episode is no example.
//!
//! | file | holds |
//! | --- | --- |
//! | `settings` | everything that can be chosen |
//! | `examples` | the posterior states of all demonstrations, computed once |
//! | `loss` | how far the actor is from what was demonstrated |
//! | `learner` | one update of the actor from examples and, if wanted, from imagination |

mod learner;
mod settings;

pub use learner::{CloningLearner, CloningUpdate};
pub use settings::{CloningSettings, Ramp};
