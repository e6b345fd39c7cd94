//! Weights that no training gives are refused before an engine sees them.
//!
//! Checking outputs is not enough: tract's vector kernels of sigmoid, tanh and SiLU clamp their input with instructions that turn
//! NaN into the bound (0.23.9, FMA and AVX-512), so that a poisoned part answers with numbers that look sound. With finite
//! weights of sane size and finite inputs no NaN can arise in between: every layer but the heads' last is normalised.

use rcwm_models::bundle::PartName;
use rcwm_models::onnx::{self, Tensor, data_type};

use super::EngineError;

/// Largest magnitude accepted; trained weights are a few units at most.
pub(crate) const WEIGHT_MAX: f32 = 1e6;
/// The largest number of 16 bits: what is larger would become infinite.
pub(crate) const HALF_WEIGHT_MAX: f32 = 65_504.0;

/// Checks every float constant of a part against the largest magnitude that is accepted.
pub(crate) fn check(part: PartName, bytes: &[u8], weight_max: f32) -> Result<(), EngineError> {
    let model = onnx::parse_self_contained(bytes).map_err(|error| EngineError::Weights {
        part,
        tensor: "the graph".into(),
        found: error.to_string(),
    })?;
    let Some(graph) = model.graph else { return Ok(()) };
    let constants = graph.node.iter().flat_map(|node| &node.attribute).filter_map(|a| a.t.as_ref());
    for tensor in graph.initializer.iter().chain(constants) {
        if let Some(value) = unfit_value(tensor, weight_max) {
            return Err(EngineError::Weights { part, tensor: tensor.name.clone(), found: value.to_string() });
        }
    }
    Ok(())
}

fn unfit_value(tensor: &Tensor, weight_max: f32) -> Option<f32> {
    if tensor.data_type != data_type::FLOAT {
        return None;
    }
    let values = tensor.raw_data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
    // Written so that NaN is invalid.
    values
        .into_iter()
        .find(|value| !matches!(value.abs().partial_cmp(&weight_max), Some(order) if order.is_le()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_16_bits_cannot_hold_is_unfit_where_they_are_kept_so() {
        let weight = Tensor::f32("w", &[1], &[70_000.0]);
        assert_eq!(
            (unfit_value(&weight, WEIGHT_MAX), unfit_value(&weight, HALF_WEIGHT_MAX)),
            (None, Some(70_000.0))
        );
        assert!(half::f16::from_f32(HALF_WEIGHT_MAX).is_finite());
    }

    #[test]
    fn only_finite_values_of_sane_size_are_fit() {
        assert_eq!(unfit_value(&Tensor::f32("w", &[2], &[1.0, -WEIGHT_MAX]), WEIGHT_MAX), None);
        for bad in [f32::NAN, f32::INFINITY, -2.0 * WEIGHT_MAX] {
            assert!(unfit_value(&Tensor::f32("w", &[2], &[1.0, bad]), WEIGHT_MAX).is_some());
        }
        assert_eq!(unfit_value(&Tensor::i64("z", &[1], &[i64::MAX]), WEIGHT_MAX), None);
    }
}
