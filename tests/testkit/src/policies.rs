//! Policies of kind `recurrent`, as ONNX files of another library might be.

use std::path::Path;

use prost::Message;
use rcwm_models::onnx::{
    Attribute, Graph, Model, Node, OperatorSet, Tensor, ValueInfo, attribute_type, data_type,
};

/// Width of the cell.
pub const HIDDEN: usize = 8;

fn node(operator: &str, inputs: &[&str], outputs: &[&str], attribute: Vec<Attribute>) -> Node {
    let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    Node {
        input: names(inputs),
        output: names(outputs),
        name: format!("make_{}", outputs.join("_")),
        op_type: operator.to_owned(),
        attribute,
        ..Node::default()
    }
}

fn int(name: &str, i: i64) -> Attribute {
    Attribute { name: name.to_owned(), i, r#type: attribute_type::INT, ..Attribute::default() }
}

/// Numbers within -0.5 and 0.5, another for every place.
fn weight(name: &str, shape: &[usize]) -> Tensor {
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|at: usize| 0.5 * (1.7 * at as f32 + name.len() as f32).sin())
        .collect();
    Tensor::f32(name, shape, &values)
}

fn float(name: &str, shape: &[usize]) -> ValueInfo {
    ValueInfo::tensor(name, data_type::FLOAT, shape)
}

/// Writes a graph of operator set 17.
pub fn write(graph: Graph, file: &Path) {
    let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
    let model = Model { ir_version: 8, graph: Some(graph), opset_import, ..Model::default() };
    std::fs::write(file, model.encode_to_vec()).unwrap();
}

/// Two layers on the measured state of Meta-World's arm; nothing is carried.
pub fn mlp() -> Graph {
    Graph {
        name: "mlp".into(),
        node: vec![
            node("Gemm", &["state", "w1", "b1"], &["hidden"], vec![int("transB", 1)]),
            node("Relu", &["hidden"], &["active"], vec![]),
            node("Gemm", &["active", "w2", "b2"], &["out"], vec![int("transB", 1)]),
            node("Tanh", &["out"], &["action"], vec![]),
        ],
        initializer: vec![
            weight("w1", &[16, 18]),
            weight("b1", &[16]),
            weight("w2", &[4, 16]),
            weight("b2", &[4]),
        ],
        input: vec![float("state", &[1, 18])],
        output: vec![float("action", &[1, 4])],
        ..Graph::default()
    }
}

/// An LSTM on picture, measured state and executed action of Meta-World's arm; carries `state.h` and `state.c`.
pub fn lstm() -> Graph {
    let carried = [1, 1, HIDDEN];
    Graph {
        name: "lstm".into(),
        node: vec![
            node("Cast", &["image"], &["pixels"], vec![int("to", i64::from(data_type::FLOAT))]),
            node("Div", &["pixels", "full"], &["unit"], vec![]),
            node("ReduceSum", &["unit", "rows_columns"], &["sums"], vec![int("keepdims", 0)]),
            node("Mul", &["sums", "share"], &["colour"], vec![]),
            node("Concat", &["state", "executed_action", "colour"], &["seen"], vec![int("axis", 1)]),
            node("Unsqueeze", &["seen", "first"], &["x"], vec![]),
            node(
                "LSTM",
                &["x", "w", "r", "b", "", "state.h", "state.c"],
                &["", "next_state.h", "next_state.c"],
                vec![int("hidden_size", HIDDEN as i64)],
            ),
            node("Squeeze", &["next_state.h", "first"], &["h"], vec![]),
            node("MatMul", &["h", "w_out"], &["out"], vec![]),
            node("Tanh", &["out"], &["action"], vec![]),
        ],
        initializer: vec![
            Tensor::f32("full", &[], &[255.0]),
            Tensor::f32("share", &[], &[1.0 / 4096.0]),
            Tensor::i64("rows_columns", &[2], &[1, 2]),
            Tensor::i64("first", &[1], &[0]),
            weight("w", &[1, 4 * HIDDEN, 25]),
            weight("r", &[1, 4 * HIDDEN, HIDDEN]),
            weight("b", &[1, 8 * HIDDEN]),
            weight("w_out", &[HIDDEN, 4]),
        ],
        input: vec![
            ValueInfo::tensor("image", data_type::UINT8, &[1, 64, 64, 3]),
            float("state", &[1, 18]),
            float("executed_action", &[1, 4]),
            float("state.h", &carried),
            float("state.c", &carried),
        ],
        output: vec![
            float("action", &[1, 4]),
            float("next_state.h", &carried),
            float("next_state.c", &carried),
        ],
        ..Graph::default()
    }
}

/// A GRU on the measured state, which carries `state.h` on through the sequence that its cell gives, not through its last state.
pub fn gru() -> Graph {
    let carried = [1, 1, HIDDEN];
    Graph {
        name: "gru".into(),
        node: vec![
            node("Unsqueeze", &["state", "first"], &["x"], vec![]),
            node(
                "GRU",
                &["x", "w", "r", "", "", "state.h"],
                &["sequence", ""],
                vec![int("hidden_size", HIDDEN as i64)],
            ),
            node("Squeeze", &["sequence", "first"], &["next_state.h"], vec![]),
            node("Squeeze", &["next_state.h", "first"], &["h"], vec![]),
            node("MatMul", &["h", "w_out"], &["out"], vec![]),
            node("Tanh", &["out"], &["action"], vec![]),
        ],
        initializer: vec![
            Tensor::i64("first", &[1], &[0]),
            weight("w", &[1, 3 * HIDDEN, 18]),
            weight("r", &[1, 3 * HIDDEN, HIDDEN]),
            weight("w_out", &[HIDDEN, 4]),
        ],
        input: vec![float("state", &[1, 18]), float("state.h", &carried)],
        output: vec![float("action", &[1, 4]), float("next_state.h", &carried)],
        ..Graph::default()
    }
}

/// The [`mlp`] on an operator of `limit` minus the measured state, with a `Relu` behind it that may hide what is no number.
pub fn diverging(limit: f32, of_difference: &str) -> Graph {
    let mut graph = mlp();
    graph.initializer.push(Tensor::f32("limit", &[], &[limit]));
    let diverged = node(of_difference, &["difference"], &["diverged"], vec![]);
    let before = [
        node("Sub", &["limit", "state"], &["difference"], vec![]),
        diverged,
        node("Relu", &["diverged"], &["seen"], vec![]),
    ];
    graph.node[0].input[0] = "seen".into();
    graph.node.splice(0..0, before);
    graph
}
