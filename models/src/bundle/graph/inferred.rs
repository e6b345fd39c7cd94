//! What an operator makes of its inputs, for all of them.

use super::value::Value;

/// What a rule gives: the outputs, or what does not fit.
pub(super) type Inferred = Result<Vec<Value>, String>;

/// The inputs, which must be this many.
pub(super) fn take<'a, const N: usize>(inputs: &[&'a Value]) -> Result<[&'a Value; N], String> {
    inputs.try_into().map_err(|_| format!("{} inputs, expected {N}", inputs.len()))
}
