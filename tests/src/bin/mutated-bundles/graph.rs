//! Changes of an ONNX graph that leave it a readable file.

use prost::Message;
use rand::Rng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rcwm_models::onnx::{Attribute, Graph, Model, Node, OperatorSet, Tensor, attribute_type, data_type};

/// Numbers at which programs break.
pub(crate) const HARD_INTEGERS: [i64; 14] =
    [0, 1, -1, 2, 3, 7, 255, 65_536, 1 << 31, (1 << 32) + 1, 1 << 40, 1 << 62, i64::MAX, i64::MIN];
/// Operators that are known to allocate, to index or to loop, beside those of the file itself.
const OPERATORS: [&str; 22] = [
    "ConstantOfShape",
    "Expand",
    "Tile",
    "Pad",
    "Range",
    "Resize",
    "Gather",
    "GatherND",
    "ScatterND",
    "Slice",
    "OneHot",
    "Loop",
    "If",
    "Scan",
    "LSTM",
    "Einsum",
    "NonZero",
    "TopK",
    "CumSum",
    "Identity",
    "Squeeze",
    "Unsqueeze",
];

/// Makes one to three changes; gives what was done and the file.
pub(crate) fn change(rng: &mut ChaCha8Rng, bytes: &[u8]) -> (String, Vec<u8>) {
    let mut model = Model::decode(bytes).unwrap_or_default();
    let mut what = Vec::new();
    for _ in 0..rng.random_range(1..=3) {
        what.push(change_once(rng, &mut model));
    }
    (what.join("; "), model.encode_to_vec())
}

fn change_once(rng: &mut ChaCha8Rng, model: &mut Model) -> String {
    if rng.random_ratio(1, 30) {
        let version = hard(rng);
        model.opset_import.push(OperatorSet { domain: String::new(), version });
        return format!("operator set {version} added");
    }
    let Some(graph) = &mut model.graph else { return "no graph".into() };
    if graph.node.is_empty() || graph.initializer.is_empty() {
        return "nothing left to change".into();
    }
    let at = rng.random_range(0..graph.node.len());
    match rng.random_range(0..12) {
        0 => wire(rng, graph, at),
        1 => {
            let other = rng.random_range(0..graph.node.len());
            graph.node.swap(at, other);
            format!("nodes {at} and {other} change places")
        }
        2 => format!("node {} left out", graph.node.remove(at).name),
        3 => operator(rng, graph, at),
        4 | 5 => attribute(rng, &mut graph.node[at]),
        6 | 7 => {
            let index = rng.random_range(0..graph.initializer.len());
            constant(rng, &mut graph.initializer[index])
        }
        8 => integers(rng, graph),
        9 => claim(rng, graph),
        10 => {
            let node = graph.node[at].clone();
            graph.node.push(node);
            format!("node {at} is there twice")
        }
        _ => added_node(rng, graph),
    }
}

fn hard(rng: &mut ChaCha8Rng) -> i64 {
    HARD_INTEGERS.choose(rng).copied().unwrap_or(0)
}

/// Any value's name.
fn name(rng: &mut ChaCha8Rng, graph: &Graph) -> String {
    let nodes = graph.node.iter().flat_map(|node| &node.output);
    let constants = graph.initializer.iter().map(|tensor| &tensor.name);
    let inputs = graph.input.iter().map(|input| &input.name);
    let names: Vec<&String> = nodes.chain(constants).chain(inputs).collect();
    names.choose(rng).map_or_else(String::new, |name| (*name).clone())
}

fn wire(rng: &mut ChaCha8Rng, graph: &mut Graph, at: usize) -> String {
    let name = if rng.random_bool(0.9) { name(rng, graph) } else { String::new() };
    let node = &mut graph.node[at];
    match rng.random_range(0..4) {
        0 => node.input.push(name.clone()),
        1 => drop(node.input.pop()),
        2 => node.output.iter_mut().take(1).for_each(|output| output.clone_from(&name)),
        _ => node.input.iter_mut().take(1).for_each(|input| input.clone_from(&name)),
    }
    format!("node {} is wired to {name:?}", node.name)
}

fn operator(rng: &mut ChaCha8Rng, graph: &mut Graph, at: usize) -> String {
    let own: Vec<String> = graph.node.iter().map(|node| node.op_type.clone()).collect();
    let other = OPERATORS.choose(rng).map_or_else(String::new, ToString::to_string);
    let operator = if rng.random_bool(0.6) { own.choose(rng).cloned().unwrap_or(other) } else { other };
    let node = &mut graph.node[at];
    let what = format!("node {}: {} becomes {operator}", node.name, node.op_type);
    node.op_type = operator;
    what
}

fn attribute(rng: &mut ChaCha8Rng, node: &mut Node) -> String {
    let value = hard(rng);
    let len = node.attribute.len();
    if len == 0 || rng.random_bool(0.2) {
        const NAMES: [&str; 8] =
            ["axis", "axes", "group", "dilations", "output_padding", "auto_pad", "keepdims", "allowzero"];
        let name = NAMES.choose(rng).map_or_else(String::new, ToString::to_string);
        let kind = if rng.random_bool(0.5) { attribute_type::INT } else { attribute_type::INTS };
        let ints = vec![value; rng.random_range(0..5)];
        node.attribute.push(Attribute {
            name: name.clone(),
            i: value,
            ints,
            r#type: kind,
            ..Attribute::default()
        });
        return format!("node {}: attribute {name} = {value} added", node.name);
    }
    let attribute = &mut node.attribute[rng.random_range(0..len)];
    let name = attribute.name.clone();
    match rng.random_range(0..4) {
        0 => attribute.r#type = value as i32 & 15,
        1 if !attribute.ints.is_empty() => {
            let at = rng.random_range(0..attribute.ints.len());
            attribute.ints[at] = value;
        }
        2 => attribute.ints.push(value),
        3 => attribute.f = f32::NAN,
        _ => {
            attribute.i = value;
            attribute.ints.iter_mut().for_each(|x| *x = value);
        }
    }
    format!("node {}: attribute {name} with {value}", node.name)
}

fn constant(rng: &mut ChaCha8Rng, tensor: &mut Tensor) -> String {
    let value = hard(rng);
    let what = format!("constant {:?} {:?} with {value}", tensor.name, tensor.dims);
    match rng.random_range(0..6) {
        0 => tensor.dims.push(value),
        1 => drop(tensor.dims.pop()),
        2 => tensor.dims.reverse(),
        3 => tensor.data_type = value as i32 & 31,
        4 => tensor.dims.iter_mut().take(1).for_each(|dim| *dim = value),
        _ => {
            // The same number of bytes in another shape.
            let elements: i64 = tensor.dims.iter().product();
            tensor.dims = vec![elements, 1];
        }
    }
    what
}

/// Shapes, axes, split sizes and index offsets are constants of integers.
fn integers(rng: &mut ChaCha8Rng, graph: &mut Graph) -> String {
    let value = hard(rng);
    let lists: Vec<usize> = (0..graph.initializer.len())
        .filter(|index| graph.initializer[*index].data_type == data_type::INT64)
        .filter(|index| graph.initializer[*index].raw_data.len() >= 8)
        .collect();
    let Some(index) = lists.choose(rng) else { return "no integers".into() };
    let tensor = &mut graph.initializer[*index];
    let at = rng.random_range(0..tensor.raw_data.len() / 8) * 8;
    tensor.raw_data[at..at + 8].copy_from_slice(&value.to_le_bytes());
    format!("constant {:?} holds {value}", tensor.name)
}

/// What the file says of a value in between.
fn claim(rng: &mut ChaCha8Rng, graph: &mut Graph) -> String {
    let (value, len) = (hard(rng), graph.value_info.len());
    if len == 0 {
        return "no claims".into();
    }
    let info = &mut graph.value_info[rng.random_range(0..len)];
    let tensor = info.r#type.as_mut().and_then(|kind| kind.tensor_type.as_mut());
    if let Some(tensor) = tensor {
        if rng.random_bool(0.3) {
            tensor.elem_type = value as i32 & 31;
        } else if let Some(dim) = tensor.shape.as_mut().and_then(|shape| shape.dim.first_mut()) {
            dim.dim_value = Some(value);
        }
    }
    format!("{} is said to be of {value}", info.name)
}

/// A node of an operator that makes large values, on whatever inputs.
fn added_node(rng: &mut ChaCha8Rng, graph: &mut Graph) -> String {
    let value = hard(rng);
    let op_type = OPERATORS.choose(rng).map_or_else(String::new, ToString::to_string);
    graph.initializer.push(Tensor::i64("hard", &[2], &[value, value]));
    let output = match rng.random_bool(0.5) {
        true => "added".to_owned(),
        // In the way of a value that is used.
        false => name(rng, graph),
    };
    graph.node.insert(
        rng.random_range(0..=graph.node.len()),
        Node {
            input: vec!["hard".into(), name(rng, graph), "hard".into()],
            output: vec![output.clone()],
            name: "added".into(),
            op_type: op_type.clone(),
            ..Node::default()
        },
    );
    format!("{op_type} of {value} added as {output}")
}
