use candle_core::{D, Result, Tensor};

use super::sigmoid;

/// The gates of the recurrent cell: `gates` [B, 3d] holds `reset, cand, update` after their LayerNorm; gives
/// `h' = update * cand + (1 - update) * h` [B, d], where `cand = tanh(sigmoid(reset) * cand)` and
/// `update = sigmoid(update - 1)`: a new cell keeps what it knows.
pub fn recurrent_update(gates: &Tensor, h: &Tensor) -> Result<Tensor> {
    let d = h.dim(D::Minus1)?;
    let gate = |index: usize| gates.narrow(D::Minus1, index * d, d);
    let reset = sigmoid(&gate(0)?)?;
    let cand = (reset * gate(1)?)?.tanh()?;
    let update = sigmoid(&(gate(2)? - 1.0)?)?;
    h + (update * (cand - h)?)?
}
