//! Operators that only move data.

use super::DType;
use super::attributes::Attributes;
use super::inferred::{Inferred, take};
use super::value::Value;

/// The numbers of an input that must be known before anything runs.
pub(super) fn constant_integers<'a>(value: &'a Value, what: &str) -> Result<&'a [i64], String> {
    match &value.integers {
        Some(integers) if value.rank() == 1 => Ok(integers),
        _ => Err(format!("{what} are {}, expected a short constant list of integers", value.text())),
    }
}

pub(super) fn concat(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let (first, rest) = inputs.split_first().ok_or("no inputs")?;
    let axis = attributes.int("axis")?.ok_or("attribute \"axis\" is missing")?;
    let axis = super::attributes::axis_of(axis, first.rank())?;
    let mut joined = (*first).clone();
    for input in rest {
        let others = |shape: &[usize]| -> Vec<usize> {
            shape.iter().enumerate().filter(|(i, _)| *i != axis).map(|(_, dim)| *dim).collect()
        };
        let fits = input.rank() == joined.rank() && others(&input.shape) == others(&joined.shape);
        if !fits || input.dtype != joined.dtype {
            return Err(format!("{} cannot follow {} on axis {axis}", input.text(), joined.text()));
        }
        joined.shape[axis] = joined.shape[axis].saturating_add(input.shape[axis]);
        joined.range = joined.range.zip(input.range).map(|(a, b)| (a.0.min(b.0), a.1.max(b.1)));
    }
    Ok(vec![joined.reshaped(joined.shape.clone())])
}

pub(super) fn gather(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [table, indices] = take(inputs)?;
    let axis = attributes.axis(0, table.rank())?;
    let rows = table.shape[axis];
    match (indices.dtype, indices.range) {
        (DType::I64, Some((min, max))) if min >= 0 && max < rows as i64 => {}
        (DType::I64, range) => return Err(format!("indices lie in {range:?}, the table has {rows} rows")),
        _ => return Err(format!("indices are {}, expected integers", indices.text())),
    }
    let shape = [&table.shape[..axis], &indices.shape, &table.shape[axis + 1..]].concat();
    Ok(vec![table.reshaped(shape)])
}

pub(super) fn reshape(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    attributes.only_int("allowzero", 0)?;
    let [x, wanted] = take(inputs)?;
    let wanted = constant_integers(wanted, "the shape")?;
    let invalid = || format!("{:?} cannot become {wanted:?}", x.shape);
    let mut shape = Vec::new();
    let mut open = None;
    for (i, dim) in wanted.iter().enumerate() {
        shape.push(match dim {
            -1 if open.is_none() => {
                open = Some(i);
                1
            }
            // Zero keeps the dimension that is there.
            0 => *x.shape.get(i).ok_or_else(invalid)?,
            dim => usize::try_from(*dim).map_err(|_| invalid())?,
        });
    }
    let product =
        shape.iter().try_fold(1_usize, |product, dim| product.checked_mul(*dim)).ok_or_else(invalid)?;
    if let Some(open) = open {
        shape[open] = x.elements().checked_div(product).ok_or_else(invalid)?;
    }
    let reshaped = x.reshaped(shape);
    if reshaped.elements() == x.elements() { Ok(vec![reshaped]) } else { Err(invalid()) }
}

pub(super) fn split(attributes: &mut Attributes<'_>, inputs: &[&Value], outputs: usize) -> Inferred {
    let [x, sizes] = take(inputs)?;
    let axis = attributes.axis(0, x.rank())?;
    let sizes = constant_integers(sizes, "sizes")?;
    let invalid =
        || format!("{:?} on axis {axis} cannot be split into {sizes:?} for {outputs} outputs", x.shape);
    let lens = sizes.iter().map(|len| usize::try_from(*len).ok().filter(|len| *len > 0));
    let lens: Vec<usize> = lens.collect::<Option<_>>().ok_or_else(invalid)?;
    let sum = lens.iter().try_fold(0_usize, |sum, len| sum.checked_add(*len));
    if sum != Some(x.shape[axis]) || lens.len() != outputs {
        return Err(invalid());
    }
    let part = |len| {
        let mut shape = x.shape.clone();
        shape[axis] = len;
        x.reshaped(shape)
    };
    Ok(lens.into_iter().map(part).collect())
}

pub(super) fn transpose(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = take(inputs)?;
    let order = attributes.ints("perm")?.ok_or("attribute \"perm\" is missing")?;
    let mut sorted = order.to_vec();
    sorted.sort_unstable();
    if !sorted.into_iter().eq(0..x.rank() as i64) {
        return Err(format!("perm {order:?} of {:?}", x.shape));
    }
    // The numbers are 0 to rank - 1: checked above.
    let shape = order.iter().map(|axis| x.shape[*axis as usize]).collect();
    Ok(vec![x.reshaped(shape)])
}
