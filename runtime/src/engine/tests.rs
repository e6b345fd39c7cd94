use prost::Message;
use rcwm_models::onnx::{Graph, Model, Node, OperatorSet, Tensor, ValueInfo, data_type};

use super::*;

const LEN: usize = 3;

/// `e = noise * 2`, `classes = z + 1`: two inputs and two outputs of two types, not in alphabetical order.
fn source(bytes: &[u8]) -> Source<'_> {
    let spec = TensorSpec::new;
    Source {
        part: PartName::Actor,
        bytes,
        inputs: vec![spec("z", DType::I64, &[1, LEN]), spec("noise", DType::F32, &[1, LEN])],
        outputs: vec![spec("e", DType::F32, &[1, LEN]), spec("classes", DType::I64, &[1, LEN])],
    }
}

fn graph_bytes() -> Vec<u8> {
    let node = |op: &str, inputs: [&str; 2], output: &str| Node {
        op_type: op.into(),
        input: inputs.map(String::from).to_vec(),
        output: vec![output.into()],
        name: format!("make_{output}"),
        ..Node::default()
    };
    let value = |name, elem_type| ValueInfo::tensor(name, elem_type, &[1, LEN]);
    let graph = Graph {
        name: "tiny".into(),
        node: vec![node("Mul", ["noise", "two"], "e"), node("Add", ["z", "one"], "classes")],
        initializer: vec![Tensor::f32("two", &[1], &[2.0]), Tensor::i64("one", &[1], &[1])],
        input: vec![value("z", data_type::INT64), value("noise", data_type::FLOAT)],
        output: vec![value("e", data_type::FLOAT), value("classes", data_type::INT64)],
        ..Graph::default()
    };
    let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
    Model { ir_version: 8, graph: Some(graph), opset_import, ..Model::default() }.encode_to_vec()
}

fn check(part: &mut dyn Part) {
    let (mut e, mut classes) = ([0.0; LEN], [0; LEN]);
    // Twice: the second run must not see the first one's inputs.
    for factor in [1.0, -3.0] {
        let noise = [0.5, 1.5, f32::MIN_POSITIVE].map(|x| x * factor);
        part.run(
            &[Input::I64(&[4, 5, factor as i64]), Input::F32(&noise)],
            &mut [Output::F32(&mut e), Output::I64(&mut classes)],
        )
        .unwrap();
        assert_eq!(e, noise.map(|x| 2.0 * x));
        assert_eq!(classes, [5, 6, factor as i64 + 1]);
    }
}

#[test]
fn tract_runs_a_part_in_the_signature_s_order() {
    check(&mut tract::TractPart::load(source(&graph_bytes())).unwrap());
}

#[cfg(feature = "ort")]
#[test]
fn onnx_runtime_gives_what_tract_gives_or_says_how_to_name_its_library() {
    match onnxruntime::OrtPart::load(source(&graph_bytes()), 1) {
        Ok(mut part) => check(&mut part),
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains("ORT_DYLIB_PATH") && text.contains("--engine tract"), "{text}");
            eprintln!("ONNX Runtime was not compared: {text}");
        }
    }
}

#[test]
fn a_tensor_of_the_wrong_length_or_type_is_refused_before_anything_runs() {
    let mut part = tract::TractPart::load(source(&graph_bytes())).unwrap();
    let (mut e, mut classes) = ([0.0; LEN], [0; LEN]);
    let short = part.run(
        &[Input::I64(&[0; LEN]), Input::F32(&[0.0; LEN - 1])],
        &mut [Output::F32(&mut e), Output::I64(&mut classes)],
    );
    assert!(matches!(short, Err(EngineError::Tensor { .. })));
    let swapped = part.run(
        &[Input::I64(&[0; LEN]), Input::F32(&[0.0; LEN])],
        &mut [Output::I64(&mut classes), Output::F32(&mut e)],
    );
    assert!(matches!(swapped, Err(EngineError::Tensor { .. })));
}

#[test]
fn bytes_that_are_no_graph_are_a_load_error_of_one_line() {
    let error = tract::TractPart::load(source(b"not an onnx file")).err().unwrap();
    assert!(matches!(error, EngineError::Load { .. }));
    assert!(!error.to_string().contains('\n'));
}
