//! What an operator makes of its inputs, for all of them.

use super::DType;
use super::attributes::axis_of;
use super::value::Value;

/// What a rule gives: the outputs, or what does not fit.
pub(super) type Inferred = Result<Vec<Value>, String>;

/// The inputs, which must be this many.
pub(super) fn take<'a, const N: usize>(inputs: &[&'a Value]) -> Result<[&'a Value; N], String> {
    inputs.try_into().map_err(|_| format!("{} inputs, expected {N}", inputs.len()))
}

/// The same, of floats.
pub(super) fn floats<'a, const N: usize>(inputs: &[&'a Value]) -> Result<[&'a Value; N], String> {
    let inputs = take::<N>(inputs)?;
    match inputs.iter().find(|input| input.dtype != DType::F32 || input.is_absent) {
        None => Ok(inputs),
        Some(other) => Err(format!("an input is {}, expected floats", other.text())),
    }
}

/// The shape of two values that are taken together element by element.
pub(super) fn broadcast(a: &[usize], b: &[usize]) -> Result<Vec<usize>, String> {
    let rank = a.len().max(b.len());
    let dim = |shape: &[usize], i: usize| (i + shape.len()).checked_sub(rank).map_or(1, |i| shape[i]);
    (0..rank)
        .map(|i| match (dim(a, i), dim(b, i)) {
            (x, y) if x == y => Ok(x),
            (1, x) | (x, 1) => Ok(x),
            _ => Err(format!("shapes {a:?} and {b:?} do not go together")),
        })
        .collect()
}

pub(super) fn reduced(shape: &[usize], axes: &[usize], keep: bool) -> Vec<usize> {
    let each = shape.iter().enumerate();
    if keep {
        each.map(|(i, dim)| if axes.contains(&i) { 1 } else { *dim }).collect()
    } else {
        each.filter(|(i, _)| !axes.contains(i)).map(|(_, dim)| *dim).collect()
    }
}

/// Two factors, and a bias where there is one.
pub(super) fn with_bias<'a>(
    inputs: &[&'a Value],
) -> Result<(&'a Value, &'a Value, Option<&'a Value>), String> {
    match inputs.len() {
        2 => floats(inputs).map(|[a, b]| (a, b, None)),
        _ => floats(inputs).map(|[a, b, bias]| (a, b, Some(bias))),
    }
}

/// Axes that are there, none twice.
pub(super) fn distinct(axes: &[i64], rank: usize) -> Result<Vec<usize>, String> {
    let mut seen = Vec::new();
    for axis in axes {
        let axis = axis_of(*axis, rank)?;
        if seen.contains(&axis) {
            return Err(format!("axes {axes:?} name one twice"));
        }
        seen.push(axis);
    }
    Ok(seen)
}
