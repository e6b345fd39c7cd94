//! Actor-critic learning in imagination (spec: behaviour; eq. 10-12).

mod imagination;
mod returns;

pub use imagination::{Imagination, imagine};
pub use returns::{lambda_return, step_weights};

/// How far is imagined and how the future is discounted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Horizon {
    /// L: states of an imagination, the start included.
    pub length: usize,
    /// gamma, applied on top of the predicted continuation.
    pub discount: f64,
    /// lambda of the return.
    pub lambda: f64,
}

impl Default for Horizon {
    /// The paper's (Table 2).
    fn default() -> Self {
        Self { length: 15, discount: 0.997, lambda: 0.95 }
    }
}
