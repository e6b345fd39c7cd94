//! Operators that policies of other libraries use beside ours: recurrent cells, small networks on vectors and pictures.

use super::attributes::{Attributes, axis_of};
use super::inferred::{Inferred, broadcast, distinct, floats, reduced, take, with_bias};
use super::movement::constant_integers;
use super::value::Value;
use super::window::{Window, picture_side, small};
use super::{DType, Limits};

/// Operators of which an input may be left out.
pub(super) const WITH_OPTIONAL_INPUTS: [&str; 3] = ["Clip", "GRU", "LSTM"];

/// The outputs of an operator; none when it is not on the list. `outputs` is how many the node names.
pub(super) fn infer(
    operator: &str,
    attributes: &mut Attributes<'_>,
    inputs: &[&Value],
    outputs: usize,
) -> Option<Inferred> {
    Some(match operator {
        "Elu" | "LeakyRelu" | "Selu" | "HardSigmoid" => with_numbers(attributes, inputs),
        "Cos" | "Erf" | "HardSwish" | "Reciprocal" | "Sin" | "Softplus" | "Softsign" => {
            floats::<1>(inputs).map(|[x]| vec![Value::new(DType::F32, x.shape.clone())])
        }
        "BatchNormalization" => batch_norm(attributes, inputs),
        "Clip" => clip(inputs),
        "Constant" => constant(attributes, inputs),
        "Flatten" => flatten(attributes, inputs),
        "GRU" => cell(attributes, inputs, outputs, 3),
        "Gelu" => gelu(attributes, inputs),
        "Gemm" => gemm(attributes, inputs),
        "GlobalAveragePool" => global_pool(inputs),
        "Identity" => take::<1>(inputs).map(|[x]| vec![x.reshaped(x.shape.clone())]),
        "LSTM" => cell(attributes, inputs, outputs, 4),
        "AveragePool" | "MaxPool" => pool(attributes, inputs, operator == "AveragePool"),
        "Pow" => floats::<2>(inputs)
            .and_then(|[a, b]| Ok(vec![Value::new(DType::F32, broadcast(&a.shape, &b.shape)?)])),
        "ReduceMean" => reduce_mean(attributes, inputs),
        "Slice" => slice(inputs),
        "Squeeze" => squeeze(inputs),
        "Unsqueeze" => unsqueeze(inputs),
        _ => return None,
    })
}

/// Activations that have numbers of their own.
fn with_numbers(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    attributes.finite(&["alpha", "beta", "gamma"])?;
    Ok(vec![Value::new(DType::F32, x.shape.clone())])
}

fn gelu(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    match attributes.string("approximate")?.as_deref() {
        None | Some("none" | "tanh") => Ok(vec![Value::new(DType::F32, x.shape.clone())]),
        Some(other) => Err(format!("approximate is {other:?}")),
    }
}

fn batch_norm(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x, others @ ..] = floats::<5>(inputs)?;
    let channels = x.shape.get(1).copied();
    if others.iter().any(|other| other.shape.len() != 1 || other.shape.first().copied() != channels) {
        return Err(format!("input of shape {:?} with scale of {:?}", x.shape, others[0].shape));
    }
    match attributes.float("epsilon")? {
        Some(epsilon) if !(epsilon.is_finite() && epsilon > 0.0) => {
            return Err(format!("epsilon is {epsilon}"));
        }
        _ => {}
    }
    // Of training only.
    attributes.float("momentum")?;
    if attributes.flag("training_mode", false)? {
        return Err("training_mode is 1; export the policy for inference".into());
    }
    Ok(vec![Value::new(DType::F32, x.shape.clone())])
}

fn clip(inputs: &[&Value]) -> Inferred {
    let (x, bounds) = inputs.split_first().ok_or("no inputs")?;
    let is_scalar = |bound: &&Value| bound.dtype == DType::F32 && bound.elements() == 1 || bound.is_absent;
    if x.dtype != DType::F32 || x.is_absent || bounds.len() > 2 || !bounds.iter().all(is_scalar) {
        return Err(format!("{} with {} bounds, expected floats and scalars", x.text(), bounds.len()));
    }
    Ok(vec![Value::new(DType::F32, x.shape.clone())])
}

fn constant(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [] = take(inputs)?;
    let tensor = attributes.tensor("value")?.ok_or("attribute \"value\" is missing")?;
    Ok(vec![Value::constant(tensor, Limits::RANK)?])
}

fn flatten(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    let axis = match attributes.int("axis")?.unwrap_or(1) {
        axis if axis == x.rank() as i64 => x.rank(),
        axis => axis_of(axis, x.rank())?,
    };
    let (outer, inner) = x.shape.split_at(axis);
    Ok(vec![x.reshaped(vec![outer.iter().product(), inner.iter().product()])])
}

/// `x W + b`, each matrix turned if its flag says so.
fn gemm(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    let (a, b, bias) = with_bias(inputs)?;
    attributes.finite(&["alpha", "beta"])?;
    let matrix = |value: &Value, turned: bool| match value.shape[..] {
        [rows, columns] => Ok(if turned { [columns, rows] } else { [rows, columns] }),
        _ => Err(format!("{} is no matrix", value.text())),
    };
    let [rows, inner] = matrix(a, attributes.flag("transA", false)?)?;
    let [b_inner, columns] = matrix(b, attributes.flag("transB", false)?)?;
    let shape = vec![rows, columns];
    let bias_fits = match bias {
        None => true,
        Some(bias) => broadcast(&bias.shape, &shape)? == shape,
    };
    if inner != b_inner || !bias_fits {
        return Err(format!("shapes {:?} and {:?} cannot be multiplied and added to", a.shape, b.shape));
    }
    Ok(vec![Value::new(DType::F32, shape)])
}

fn global_pool(inputs: &[&Value]) -> Inferred {
    let [x] = floats(inputs)?;
    match x.shape[..] {
        [n, channels, _, _] => Ok(vec![Value::new(DType::F32, vec![n, channels, 1, 1])]),
        _ => Err(format!("shape {:?}, expected 4 dimensions", x.shape)),
    }
}

fn pool(attributes: &mut Attributes<'_>, inputs: &[&Value], averages: bool) -> Inferred {
    let [x] = floats(inputs)?;
    let [n, channels, height, width] = x.shape[..] else {
        return Err(format!("shape {:?}, expected 4 dimensions", x.shape));
    };
    let kernel = attributes.ints("kernel_shape")?.ok_or("attribute \"kernel_shape\" is missing")?;
    let kernel = small(kernel, 1, 64)?;
    attributes.only_int("ceil_mode", 0)?;
    if averages {
        attributes.flag("count_include_pad", false)?;
    } else {
        attributes.only_int("storage_order", 0)?;
    }
    let window = Window::read(attributes, kernel)?;
    let (height, width) = (picture_side(&window, 0, height)?, picture_side(&window, 1, width)?);
    Ok(vec![Value::new(DType::F32, vec![n, channels, height, width])])
}

fn reduce_mean(attributes: &mut Attributes<'_>, inputs: &[&Value]) -> Inferred {
    attributes.only_int("noop_with_empty_axes", 0)?;
    let (x, axes) = match inputs.len() {
        // Operator set 17 has the axes as an attribute.
        1 => (inputs[0], attributes.ints("axes")?.ok_or("attribute \"axes\" is missing")?),
        _ => {
            let [x, axes] = take(inputs)?;
            (x, constant_integers(axes, "axes")?)
        }
    };
    let [x] = floats(&[x])?;
    if axes.is_empty() {
        return Err("no axes: engines differ on what that means".into());
    }
    let keep = attributes.flag("keepdims", true)?;
    Ok(vec![Value::new(DType::F32, reduced(&x.shape, &distinct(axes, x.rank())?, keep))])
}

fn squeeze(inputs: &[&Value]) -> Inferred {
    let [x, axes] = take(inputs)?;
    let axes = distinct(constant_integers(axes, "axes")?, x.rank())?;
    if axes.iter().any(|axis| x.shape[*axis] != 1) {
        return Err(format!("axes {axes:?} of {:?} are not all of one element", x.shape));
    }
    Ok(vec![x.reshaped(reduced(&x.shape, &axes, false))])
}

fn unsqueeze(inputs: &[&Value]) -> Inferred {
    let [x, axes] = take(inputs)?;
    let wanted = constant_integers(axes, "axes")?;
    let rank = x.rank() + wanted.len();
    let axes = distinct(wanted, rank)?;
    let mut left = x.shape.iter().copied();
    let shape = (0..rank).map(|i| if axes.contains(&i) { Some(1) } else { left.next() });
    let shape: Option<Vec<usize>> = shape.collect();
    Ok(vec![x.reshaped(shape.ok_or_else(|| format!("axes {wanted:?} of {:?}", x.shape))?)])
}

/// Pieces by constant starts, ends, axes and steps of 1.
fn slice(inputs: &[&Value]) -> Inferred {
    let (x, numbers) = inputs.split_first().ok_or("no inputs")?;
    let lists = numbers.iter().zip(["starts", "ends", "axes", "steps"]);
    let lists = lists.map(|(value, what)| constant_integers(value, what)).collect::<Result<Vec<_>, _>>()?;
    let (starts, ends, axes) = match lists[..] {
        [starts, ends, axes] => (starts, ends, axes),
        [starts, ends, axes, steps] if steps.iter().all(|step| *step == 1) => (starts, ends, axes),
        _ => return Err("expected constant starts, ends and axes, and steps of 1".into()),
    };
    let places = distinct(axes, x.rank())?;
    if starts.len() != places.len() || ends.len() != places.len() {
        return Err(format!("starts {starts:?}, ends {ends:?}, axes {axes:?}"));
    }
    let mut shape = x.shape.clone();
    for ((axis, start), end) in places.into_iter().zip(starts).zip(ends) {
        let len = x.shape[axis] as i64;
        let within = |at: i64| if at < 0 { at.saturating_add(len).max(0) } else { at.min(len) };
        let (start, end) = (within(*start), within(*end));
        if end <= start {
            return Err(format!("{start} to {end} of {len} elements is nothing"));
        }
        shape[axis] = (end - start) as usize;
    }
    Ok(vec![x.reshaped(shape)])
}

/// A recurrent cell of so many gates, over a sequence: X, W, R, B, no lengths, and the states before.
fn cell(attributes: &mut Attributes<'_>, inputs: &[&Value], outputs: usize, gates: usize) -> Inferred {
    let states = gates - 2;
    let [x, w, r, others @ ..] = inputs else {
        return Err(format!("{} inputs, expected at least X, W and R", inputs.len()));
    };
    let [x, w, r] = floats(&[x, w, r])?;
    let hidden = attributes.int("hidden_size")?.ok_or("attribute \"hidden_size\" is missing")?;
    let hidden = usize::try_from(hidden).map_err(|_| format!("hidden_size is {hidden}"))?;
    match attributes.string("direction")?.as_deref() {
        None | Some("forward") => {}
        Some(other) => {
            return Err(format!("direction is {other:?}, expected forward: nothing is known of later ticks"));
        }
    }
    attributes.only_int("layout", 0)?;
    if gates == 3 {
        attributes.flag("linear_before_reset", false)?;
    } else {
        attributes.only_int("input_forget", 0)?;
    }
    let [steps, batch, width] = x.shape[..] else {
        return Err(format!("X is {}, expected 3 dimensions", x.text()));
    };
    let shape = |value: &Value, expected: &[usize], what: &str| {
        let fits = value.is_absent || value.dtype == DType::F32 && value.shape == expected;
        if fits { Ok(()) } else { Err(format!("{what} is {}, expected f32 {expected:?}", value.text())) }
    };
    let all = gates.checked_mul(hidden).ok_or("hidden_size is too large")?;
    shape(w, &[1, all, width], "W")?;
    shape(r, &[1, all, hidden], "R")?;
    if !w.is_constant || !r.is_constant {
        return Err("W and R must be constants".into());
    }
    if others.len() > 2 + states {
        return Err(format!(
            "{} inputs, expected at most {}: peepholes are not accepted",
            inputs.len(),
            5 + states
        ));
    }
    for (at, other) in others.iter().enumerate() {
        match at {
            0 => shape(other, &[1, all.saturating_mul(2)], "B")?,
            1 if !other.is_absent => return Err("lengths of sequences are not accepted".into()),
            1 => {}
            _ => shape(other, &[1, batch, hidden], "a state before")?,
        }
    }
    if outputs > 1 + states {
        return Err(format!("{outputs} outputs, expected at most {}", 1 + states));
    }
    let mut all = vec![Value::new(DType::F32, vec![steps, 1, batch, hidden])];
    all.extend((0..states).map(|_| Value::new(DType::F32, vec![1, batch, hidden])));
    all.truncate(outputs);
    Ok(all)
}
