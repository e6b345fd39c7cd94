use super::*;
use crate::onnx::{Attribute, OperatorSet, attribute_type, data_type};

fn node(operator: &str, inputs: &[&str], output: &str, attribute: Vec<Attribute>) -> Node {
    Node {
        input: inputs.iter().map(|name| (*name).to_owned()).collect(),
        output: vec![output.to_owned()],
        name: format!("make_{output}"),
        op_type: operator.to_owned(),
        attribute,
        ..Node::default()
    }
}

fn int(name: &str, i: i64) -> Attribute {
    Attribute { name: name.to_owned(), i, r#type: attribute_type::INT, ..Attribute::default() }
}

/// A table of 6 rows, looked up with z + offset: z is one of 4 classes.
fn lookup(offset: i64) -> Model {
    let graph = Graph {
        node: vec![
            node("Add", &["z", "offset"], "rows", vec![]),
            node("Gather", &["table", "rows"], "out", vec![int("axis", 0)]),
        ],
        initializer: vec![Tensor::i64("offset", &[1], &[offset]), Tensor::f32("table", &[6, 2], &[0.5; 12])],
        ..Graph::default()
    };
    let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
    Model { graph: Some(graph), opset_import, ..Model::default() }
}

fn check_lookup(model: &Model) -> Result<(), GraphError> {
    let inputs = [TensorSpec::new("z", DType::I64, &[1, 3])];
    check(model, &inputs, &[TensorSpec::new("out", DType::F32, &[1, 3, 2])], 4)
}

fn changed(change: impl FnOnce(&mut Graph)) -> Result<(), GraphError> {
    let mut model = lookup(2);
    change(model.graph.as_mut().unwrap());
    check_lookup(&model)
}

#[test]
fn a_graph_whose_every_value_fits_is_accepted() {
    check_lookup(&lookup(2)).unwrap();
}

#[test]
fn an_index_that_may_leave_its_table_is_refused() {
    for offset in [3, -1, i64::MAX, i64::MIN] {
        let error = check_lookup(&lookup(offset)).unwrap_err();
        assert!(matches!(error, GraphError::Node { .. }), "{offset}: {error}");
    }
}

/// A part that adds `offset` to the classes that enter, and gives them out again.
fn shifted_classes(offset: &[i64]) -> Result<(), GraphError> {
    let mut model = lookup(0);
    let graph = model.graph.as_mut().unwrap();
    graph.node = vec![node("Add", &["z", "offset"], "out", vec![])];
    graph.initializer = vec![Tensor::i64("offset", &[offset.len()], offset)];
    let z = |name| TensorSpec::new(name, DType::I64, &[1, 3]);
    check(&model, &[z("z")], &[z("out")], 4)
}

#[test]
fn an_output_that_may_be_no_class_is_refused_whatever_the_graph_computes() {
    shifted_classes(&[0]).unwrap();
    for offset in [&[1][..], &[-1], &[1_000_000], &[0, 0, 1], &[1 << 62]] {
        let error = shifted_classes(offset).unwrap_err();
        assert!(matches!(error, GraphError::Range { class_max: 3, .. }), "{offset:?}: {error}");
    }
}

#[test]
fn an_output_that_jumps_only_for_some_action_is_refused_as_well() {
    // The class is looked up in a table of offsets, by an index that depends on an input.
    let mut model = lookup(0);
    let graph = model.graph.as_mut().unwrap();
    graph.node = vec![
        node("ArgMax", &["scores"], "which", vec![int("axis", 1), int("keepdims", 1)]),
        node("Gather", &["jumps", "which"], "jump", vec![int("axis", 0)]),
        node("Add", &["z", "jump"], "out", vec![]),
    ];
    let check_jumps = |jumps: [i64; 2]| {
        let mut model = model.clone();
        model.graph.as_mut().unwrap().initializer = vec![Tensor::i64("jumps", &[2], &jumps)];
        let inputs =
            [TensorSpec::new("z", DType::I64, &[1, 1]), TensorSpec::new("scores", DType::F32, &[1, 2])];
        check(&model, &inputs, &[TensorSpec::new("out", DType::I64, &[1, 1])], 4)
    };
    check_jumps([0, 0]).unwrap();
    let error = check_jumps([0, 1_000_000]).unwrap_err();
    assert!(matches!(error, GraphError::Range { range: Some((0, 1_000_003)), .. }), "{error}");
}

#[test]
fn a_constant_must_hold_what_its_shape_says() {
    let error = changed(|graph| graph.initializer[1].dims = vec![6, 3]).unwrap_err();
    assert!(matches!(error, GraphError::Constant { .. }), "{error}");
    let error = changed(|graph| graph.initializer[1].dims = vec![1 << 62, 1 << 62]).unwrap_err();
    assert!(matches!(error, GraphError::Constant { .. }), "{error}");
    let error = changed(|graph| graph.initializer[1].data_type = data_type::BOOL).unwrap_err();
    assert!(matches!(error, GraphError::Constant { .. }), "{error}");
}

#[test]
fn unknown_operators_attributes_and_names_are_refused() {
    let error = changed(|graph| graph.node[0].op_type = "ConstantOfShape".into()).unwrap_err();
    assert!(matches!(error, GraphError::Operator { .. }), "{error}");
    let error = changed(|graph| graph.node[0].attribute.push(int("broadcast", 1))).unwrap_err();
    assert!(matches!(error, GraphError::Node { .. }), "{error}");
    let error = changed(|graph| graph.node[0].input[0] = "nowhere".into()).unwrap_err();
    assert!(matches!(error, GraphError::Name { .. }), "{error}");
    let error = changed(|graph| graph.node[0].output[0] = "table".into()).unwrap_err();
    assert!(matches!(error, GraphError::Name { .. }), "{error}");
}

#[test]
fn a_product_that_asks_for_all_memory_is_refused() {
    let error = changed(|graph| {
        graph.initializer.push(Tensor::f32("column", &[9000, 1], &[1.0; 9000]));
        graph.initializer.push(Tensor::f32("row", &[1, 9000], &[1.0; 9000]));
        graph.node.push(node("MatMul", &["column", "row"], "huge", vec![]));
    });
    assert!(matches!(error.unwrap_err(), GraphError::TooLarge { .. }));
}

#[test]
fn a_claim_about_a_value_must_be_true() {
    let claim = |shape: &[usize]| {
        changed(|graph| graph.value_info = vec![ValueInfo::tensor("rows", data_type::INT64, shape)])
    };
    claim(&[1, 3]).unwrap();
    assert!(matches!(claim(&[1, 4]).unwrap_err(), GraphError::Value { .. }));
}

#[test]
fn another_operator_set_is_refused() {
    let mut model = lookup(2);
    model.opset_import[0].version = 11;
    assert!(matches!(check_lookup(&model).unwrap_err(), GraphError::OperatorSet { .. }));
}

/// One node on one constant weight; what is known of its output.
fn one(
    operator: &str,
    x: &[usize],
    w: &[usize],
    out: &[usize],
    attribute: Vec<Attribute>,
) -> Result<(), GraphError> {
    let graph = Graph {
        node: vec![node(operator, &["x", "w"], "out", attribute)],
        initializer: vec![Tensor::f32("w", w, &vec![0.5; w.iter().product()])],
        ..Graph::default()
    };
    let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
    let model = Model { graph: Some(graph), opset_import, ..Model::default() };
    let inputs = [TensorSpec::new("x", DType::F32, x)];
    check(&model, &inputs, &[TensorSpec::new("out", DType::F32, out)], 0)
}

#[test]
fn a_matrix_that_is_turned_multiplies_by_its_columns() {
    one("Gemm", &[1, 3], &[4, 3], &[1, 4], vec![int("transB", 1)]).unwrap();
    one("Gemm", &[1, 3], &[3, 4], &[1, 4], vec![]).unwrap();
    for (x, w, out) in [([1, 3], [4, 3], [1, 4]), ([1, 3], [3, 4], [1, 5])] {
        assert!(one("Gemm", &x, &w, &out, vec![]).is_err());
    }
}

/// An LSTM of 2 numbers in and `hidden` out, whose weights are for 4, of these inputs.
fn lstm(hidden: i64, inputs: &[&str], attributes: Vec<Attribute>) -> Result<(), GraphError> {
    let hidden_size = [vec![int("hidden_size", hidden)], attributes].concat();
    let mut cell = node("LSTM", inputs, "", hidden_size);
    cell.output = ["", "h", "c"].map(str::to_owned).to_vec();
    let graph = Graph {
        node: vec![cell],
        initializer: vec![
            Tensor::f32("w", &[1, 16, 2], &[0.1; 32]),
            Tensor::f32("r", &[1, 16, 4], &[0.1; 64]),
            Tensor::i64("lengths", &[1], &[1]),
        ],
        ..Graph::default()
    };
    let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
    let model = Model { graph: Some(graph), opset_import, ..Model::default() };
    let carried = |name: &str| TensorSpec::new(name, DType::F32, &[1, 1, 4]);
    let inputs = [TensorSpec::new("x", DType::F32, &[1, 1, 2]), carried("h0"), carried("c0")];
    check(&model, &inputs, &[carried("h"), carried("c")], 0)
}

#[test]
fn a_cell_may_leave_out_what_is_optional_and_nothing_else() {
    lstm(4, &["x", "w", "r", "", "", "h0", "c0"], vec![]).unwrap();
    lstm(4, &["x", "w", "r"], vec![]).unwrap();
    for inputs in [
        &["x", "", "r"][..],
        &["x", "w", "r", "", "lengths"],
        &["x", "w", "r", "", "", "w", "c0"],
        &["x", "w", "h0"],
        &["x", "w", "r", "", "", "h0", "c0", "r"],
    ] {
        assert!(matches!(lstm(4, inputs, vec![]), Err(GraphError::Node { .. })), "{inputs:?}");
    }
    for hidden in [0, 3, -4, i64::MAX] {
        assert!(lstm(hidden, &["x", "w", "r"], vec![]).is_err(), "{hidden}");
    }
    let direction = Attribute {
        name: "direction".into(),
        s: b"reverse".to_vec(),
        r#type: attribute_type::STRING,
        ..Attribute::default()
    };
    assert!(lstm(4, &["x", "w", "r"], vec![direction]).is_err());
    // An input that is left out is no scalar of another operator.
    let absent = changed(|graph| graph.node[0].input[1].clear());
    assert!(matches!(absent, Err(GraphError::Name { .. })));
}
