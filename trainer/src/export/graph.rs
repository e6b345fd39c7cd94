//! Builds an ONNX graph node by node, with the shape of every value known.

use rcwm_models::bundle::{DType, TensorSpec};
use rcwm_models::onnx::{self, Attribute, Node, OperatorSet, ValueInfo, attribute_type};

/// Operator set: the first with `LayerNormalization`.
pub const OPSET: i64 = 17;
/// Version of the file format that goes with it.
const IR_VERSION: i64 = 8;

/// A value in the graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Value {
    name: String,
    dtype: DType,
    shape: Vec<usize>,
}

impl Value {
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The element type.
    pub fn dtype(&self) -> DType {
        self.dtype
    }
}

/// A graph being built.
#[derive(Debug, Default)]
pub struct Graph {
    graph: onnx::Graph,
    outputs: Vec<(String, Value)>,
}

impl Graph {
    /// An empty graph.
    pub fn new(name: &str, doc: &str) -> Self {
        let graph =
            onnx::Graph { name: name.to_owned(), doc_string: doc.to_owned(), ..onnx::Graph::default() };
        Self { graph, outputs: Vec::new() }
    }

    /// Declares an input.
    pub fn input(&mut self, spec: &TensorSpec) -> Value {
        self.graph.input.push(ValueInfo::tensor(&spec.name, spec.dtype.to_onnx(), &spec.shape));
        Value { name: spec.name.clone(), dtype: spec.dtype, shape: spec.shape.clone() }
    }

    /// Declares an output.
    pub fn output(&mut self, name: &str, value: &Value) {
        self.outputs.push((name.to_owned(), value.clone()));
    }

    /// A constant array of floats.
    pub fn floats(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Value {
        self.constant(onnx::Tensor::f32(name, shape, values), DType::F32, shape)
    }

    /// A constant array of integers.
    pub fn integers(&mut self, name: &str, shape: &[usize], values: &[i64]) -> Value {
        self.constant(onnx::Tensor::i64(name, shape, values), DType::I64, shape)
    }

    /// A constant number.
    pub fn scalar(&mut self, value: f32) -> Value {
        self.floats(&format!("scalar_{value}"), &[], &[value])
    }

    /// Adds a constant, once per name.
    fn constant(&mut self, tensor: onnx::Tensor, dtype: DType, shape: &[usize]) -> Value {
        let value = Value { name: tensor.name.clone(), dtype, shape: shape.to_vec() };
        match self.graph.initializer.iter().find(|known| known.name == tensor.name) {
            Some(known) => {
                assert_eq!(known.raw_data, tensor.raw_data, "two constants are called {}", tensor.name)
            }
            None => self.graph.initializer.push(tensor),
        }
        value
    }

    /// Adds a node with one output.
    pub fn node(
        &mut self,
        operator: &str,
        inputs: &[&Value],
        attributes: Vec<Attribute>,
        dtype: DType,
        shape: &[usize],
    ) -> Value {
        self.nodes(operator, inputs, attributes, dtype, &[shape.to_vec()]).remove(0)
    }

    /// Adds a node with several outputs of these shapes.
    pub fn nodes(
        &mut self,
        operator: &str,
        inputs: &[&Value],
        attribute: Vec<Attribute>,
        dtype: DType,
        shapes: &[Vec<usize>],
    ) -> Vec<Value> {
        let name = format!("{operator}_{}", self.graph.node.len());
        let many = shapes.len() > 1;
        let value = |(index, shape): (usize, &Vec<usize>)| {
            let name = if many { format!("{name}_{index}") } else { name.clone() };
            Value { name, dtype, shape: shape.clone() }
        };
        let values: Vec<Value> = shapes.iter().enumerate().map(value).collect();
        self.graph.node.push(Node {
            input: inputs.iter().map(|input| input.name.clone()).collect(),
            output: values.iter().map(|value| value.name.clone()).collect(),
            op_type: operator.to_owned(),
            name,
            attribute,
            ..Node::default()
        });
        let infos = values.iter().map(|value| ValueInfo::tensor(&value.name, dtype.to_onnx(), &value.shape));
        self.graph.value_info.extend(infos);
        values
    }

    /// The finished file. Values that leave the graph get the outputs' names.
    pub fn finish(mut self) -> onnx::Model {
        for (output, value) in &self.outputs {
            rename(&mut self.graph, &value.name, output);
            self.graph.value_info.retain(|info| info.name != *output);
            self.graph.output.push(ValueInfo::tensor(output, value.dtype.to_onnx(), &value.shape));
        }
        onnx::Model {
            ir_version: IR_VERSION,
            producer_name: env!("CARGO_PKG_NAME").to_owned(),
            producer_version: env!("CARGO_PKG_VERSION").to_owned(),
            doc_string: self.graph.doc_string.clone(),
            graph: Some(self.graph),
            opset_import: vec![OperatorSet { domain: String::new(), version: OPSET }],
            functions: Vec::new(),
        }
    }
}

fn rename(graph: &mut onnx::Graph, from: &str, to: &str) {
    let names = graph.node.iter_mut().flat_map(|node| node.input.iter_mut().chain(&mut node.output));
    let infos = graph.value_info.iter_mut().map(|info| &mut info.name);
    for name in names.chain(infos).filter(|name| *name == from) {
        to.clone_into(name);
    }
}

/// An integer attribute.
pub fn int(name: &str, value: i64) -> Attribute {
    Attribute { name: name.to_owned(), i: value, r#type: attribute_type::INT, ..Attribute::default() }
}

/// A list of integers.
pub fn ints(name: &str, values: &[i64]) -> Attribute {
    Attribute {
        name: name.to_owned(),
        ints: values.to_vec(),
        r#type: attribute_type::INTS,
        ..Attribute::default()
    }
}

pub fn float(name: &str, value: f32) -> Attribute {
    Attribute { name: name.to_owned(), f: value, r#type: attribute_type::FLOAT, ..Attribute::default() }
}
