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
