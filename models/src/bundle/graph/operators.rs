//! Operators that compute: element by element, products, convolutions, reductions.

use super::attributes::Attributes;
use super::inferred::{Inferred, broadcast, distinct, floats, reduced, take, with_bias};
use super::value::Value;
use super::window::{Window, picture_side};
use super::{DType, Limits, movement, policies};
use crate::onnx::data_type;

/// The outputs of an operator; none when it is not on the list. `outputs` is how many the node names.
pub(super) fn infer(
    operator: &str,
    attributes: &mut Attributes<'_>,
    inputs: &[&Value],
    outputs: usize,
) -> Option<Inferred> {
    Some(match operator {
        "Abs" | "Exp" | "Log" | "Neg" | "Relu" | "Sigmoid" | "Sign" | "Sqrt" | "Tanh" => unary(inputs),
        "Add" | "Div" | "Max" | "Min" | "Mul" | "Sub" => binary(operator, inputs),
        "ArgMax" => arg_max(attributes, inputs),
        "Cast" => cast(attributes, inputs),
        "Conv" => conv(attributes, inputs),
        "ConvTranspose" => conv_transpose(attributes, inputs),
        "LayerNormalization" => layer_norm(attributes, inputs),
        "MatMul" => mat_mul(inputs),
        "ReduceSum" => reduce_sum(attributes, inputs),
        "LogSoftmax" | "Softmax" => softmax(attributes, inputs),
        "Concat" => movement::concat(attributes, inputs),
        "Gather" => movement::gather(attributes, inputs),
        "Reshape" => movement::reshape(attributes, inputs),
        "Split" => movement::split(attributes, inputs, outputs),
        "Transpose" => movement::transpose(attributes, inputs),
        _ => return policies::infer(operator, attributes, inputs, outputs),
    })
}

fn unary(inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    Ok(vec![Value::new(DType::F32, x.shape.clone())])
}

fn binary(operator: &str, inputs: &[&Value]) -> Inferred {
    let [a, b] = take(inputs)?;
    let shape = broadcast(&a.shape, &b.shape)?;
    match (a.dtype, b.dtype) {
        (DType::F32, DType::F32) => Ok(vec![Value::new(DType::F32, shape)]),
        (DType::I64, DType::I64) => {
            let range = range_of(operator, a, b).ok_or_else(|| {
                format!("{operator} of integers in {:?} and {:?} may leave their type", a.range, b.range)
            })?;
            Ok(vec![Value { range: Some(range), ..Value::new(DType::I64, shape) }])
        }
        _ => Err(format!("inputs are {} and {}", a.text(), b.text())),
    }
}

/// Where sums and differences of integers lie; none where that is not known to be a number.
fn range_of(operator: &str, a: &Value, b: &Value) -> Option<(i64, i64)> {
    let ((a_min, a_max), (b_min, b_max)) = (a.range?, b.range?);
    match operator {
        "Add" => Some((a_min.checked_add(b_min)?, a_max.checked_add(b_max)?)),
        "Sub" => Some((a_min.checked_sub(b_max)?, a_max.checked_sub(b_min)?)),
        _ => None,
    }
}

fn arg_max(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    let axis = attributes.axis(0, x.rank())?;
    let keep = attributes.flag("keepdims", true)?;
    let range = Some((0, x.shape[axis] as i64 - 1));
    Ok(vec![Value { range, ..Value::new(DType::I64, reduced(&x.shape, &[axis], keep)) }])
}

fn cast(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = take(inputs)?;
    match attributes.int("to")? {
        Some(to) if to == i64::from(data_type::FLOAT) => Ok(vec![Value::new(DType::F32, x.shape.clone())]),
        other => Err(format!("attribute \"to\" is {other:?}, expected {} (f32)", data_type::FLOAT)),
    }
}

fn layer_norm(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    attributes.only_int("stash_type", 1)?;
    let [x, scale, bias] = floats(inputs)?;
    let axis = attributes.axis(-1, x.rank())?;
    let width = x.shape[axis];
    if axis + 1 != x.rank() || scale.shape != [width] || bias.shape != [width] {
        return Err(format!(
            "input, scale and bias have shapes {:?}, {:?} and {:?}, expected a norm over the last dimension",
            x.shape, scale.shape, bias.shape
        ));
    }
    match attributes.float("epsilon")? {
        None => {}
        Some(epsilon) if epsilon.is_finite() && epsilon > 0.0 => {}
        Some(epsilon) => return Err(format!("epsilon is {epsilon}")),
    }
    Ok(vec![Value::new(DType::F32, x.shape.clone())])
}

fn mat_mul(inputs: &[&Value]) -> Inferred {
    let [a, b] = floats(inputs)?;
    let invalid = || format!("shapes {:?} and {:?} cannot be multiplied", a.shape, b.shape);
    let (Some((a_outer, [rows, a_inner])), Some((b_outer, [b_inner, columns]))) =
        (a.shape.split_last_chunk::<2>(), b.shape.split_last_chunk::<2>())
    else {
        return Err(invalid());
    };
    if a_inner != b_inner {
        return Err(invalid());
    }
    let mut shape = broadcast(a_outer, b_outer)?;
    shape.extend([*rows, *columns]);
    Ok(vec![Value::new(DType::F32, shape)])
}

fn reduce_sum(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x, axes] = take(inputs)?;
    if x.dtype != DType::F32 {
        return Err(format!("the input is {}, expected floats", x.text()));
    }
    let keep = attributes.flag("keepdims", true)?;
    let axes = distinct(movement::constant_integers(axes, "axes")?, x.rank())?;
    Ok(vec![Value::new(DType::F32, reduced(&x.shape, &axes, keep))])
}

fn softmax(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    attributes.axis(-1, x.rank())?;
    Ok(vec![Value::new(DType::F32, x.shape.clone())])
}

/// Shapes that enter a convolution.
struct Picture<'a> {
    /// `[N, C, H, W]`.
    x: [usize; 4],
    /// `[A, B, h, w]`: channels out of and into a convolution, the other way round in a transposed one.
    kernel: [usize; 4],
    bias: Option<&'a [usize]>,
}

/// Kernel and bias are constants.
fn picture<'a>(inputs: &[&'a Value]) -> Result<Picture<'a>, String> {
    let (x, kernel, bias) = with_bias(inputs)?;
    if !kernel.is_constant || bias.is_some_and(|bias| !bias.is_constant) {
        return Err("kernel and bias must be constants".into());
    }
    let four = |value: &Value| {
        <[usize; 4]>::try_from(value.shape.as_slice())
            .map_err(|_| format!("shape {:?}, expected 4 dimensions", value.shape))
    };
    Ok(Picture { x: four(x)?, kernel: four(kernel)?, bias: bias.map(|bias| bias.shape.as_slice()) })
}

fn check_channels(found: usize, expected: usize, bias: Option<&[usize]>, to: usize) -> Result<(), String> {
    if found != expected || bias.is_some_and(|bias| bias != [to]) {
        return Err(format!(
            "{found} channels enter a kernel for {expected}; the bias has shape {bias:?} for {to} channels"
        ));
    }
    Ok(())
}

/// What the engine unfolds a picture to must stay small as well.
fn check_unfolded(factors: [usize; 5]) -> Result<(), String> {
    let elements = factors.iter().try_fold(1_usize, |product, factor| product.checked_mul(*factor));
    match elements {
        Some(elements) if elements <= Limits::ELEMENTS => Ok(()),
        _ => Err(format!("unfolds to {factors:?} elements, at most {} are accepted", Limits::ELEMENTS)),
    }
}

fn conv(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let Picture { x: [n, c, height, width], kernel: [to, from, h, w], bias } = picture(inputs)?;
    check_channels(c, from, bias, to)?;
    let window = Window::read(attributes, [h, w])?;
    let (height, width) = (picture_side(&window, 0, height)?, picture_side(&window, 1, width)?);
    check_unfolded([c, h, w, height, width])?;
    Ok(vec![Value::new(DType::F32, vec![n, to, height, width])])
}

fn conv_transpose(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let Picture { x: [n, c, height, width], kernel: [from, to, h, w], bias } = picture(inputs)?;
    check_channels(c, from, bias, to)?;
    let window = Window::read(attributes, [h, w])?;
    attributes.only("output_padding", &[0, 0])?;
    let side = |i: usize, len: usize| -> Result<usize, String> {
        let grown = (len - 1).checked_mul(window.strides[i]).and_then(|x| x.checked_add(window.kernel[i]));
        let cut = grown.and_then(|grown| grown.checked_sub(window.pads[i]));
        cut.ok_or_else(|| format!("kernel {:?} on {height} x {width}", window.kernel))
    };
    check_unfolded([to, h, w, height, width])?;
    Ok(vec![Value::new(DType::F32, vec![n, to, side(0, height)?, side(1, width)?])])
}
