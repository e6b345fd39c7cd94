//! What a part costs: floating-point operations and weight bytes, from the graph and its shapes.
//!
//! A multiply-add counts as two operations. Element-wise operators count one operation an element, normalisations and softmax
//! a handful; moving data counts none. Weights are counted as read once a run, of a `Gather` only the rows it picks.

use std::collections::{BTreeMap, HashMap};

use rcwm_models::onnx::{self, Graph, Node, OnnxError};
use serde::Serialize;
use tract_onnx::prelude::{Framework, InferenceModelExt};
use tract_onnx::tract_hir::internal::{DimLike, Factoid};

/// Why a part's cost could not be told.
#[derive(Debug, thiserror::Error)]
pub enum CostError {
    /// The file is no ONNX graph.
    #[error(transparent)]
    Onnx(#[from] OnnxError),
    /// Its shapes could not be worked out.
    #[error("working out shapes: {0}")]
    Shapes(String),
}

/// Cost of one run of a part.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Cost {
    /// Trained numbers.
    pub parameters: u64,
    /// Floating-point operations of convolutions.
    pub convolution_flops: u64,
    /// Floating-point operations of everything.
    pub flops: u64,
    /// Bytes of weights read.
    pub weight_bytes: u64,
    /// Those of them that are convolutions'.
    pub convolution_weight_bytes: u64,
    /// How often each operator appears.
    pub operators: BTreeMap<String, u64>,
}

impl Cost {
    /// Counts a part.
    pub fn of(bytes: &[u8]) -> Result<Self, CostError> {
        let graph = onnx::parse_self_contained(bytes)?.graph.ok_or(OnnxError::NoGraph)?;
        let shapes = shapes(bytes).map_err(CostError::Shapes)?;
        let weights = Weights::of(&graph);
        let mut cost = Self { parameters: weights.parameters(), ..Self::default() };
        for node in &graph.node {
            cost.add(node, &shapes, &weights);
        }
        Ok(cost)
    }

    fn add(&mut self, node: &Node, shapes: &Shapes, weights: &Weights) {
        *self.operators.entry(node.op_type.clone()).or_default() += 1;
        let flops = flops(node, shapes);
        self.flops += flops;
        if node.op_type.starts_with("Conv") {
            self.convolution_flops += flops;
        }
        let weight_bytes = if node.op_type == "Gather" {
            // Only the rows that are picked.
            match node.input.first().and_then(|name| weights.0.get(name)) {
                Some(weight) if weight.float => elements(shapes, node.output.first()) * 4,
                _ => 0,
            }
        } else {
            node.input.iter().filter_map(|name| weights.0.get(name)).map(Weight::bytes).sum()
        };
        self.weight_bytes += weight_bytes;
        if node.op_type.starts_with("Conv") {
            self.convolution_weight_bytes += weight_bytes;
        }
    }

    /// The sum of two costs.
    #[must_use]
    pub fn plus(mut self, other: &Self) -> Self {
        self.parameters += other.parameters;
        self.convolution_flops += other.convolution_flops;
        self.flops += other.flops;
        self.weight_bytes += other.weight_bytes;
        self.convolution_weight_bytes += other.convolution_weight_bytes;
        for (operator, count) in &other.operators {
            *self.operators.entry(operator.clone()).or_default() += count;
        }
        self
    }
}

struct Weight {
    elements: u64,
    float: bool,
}

impl Weight {
    fn bytes(&self) -> u64 {
        if self.float { self.elements * 4 } else { 0 }
    }
}

/// Constants by name.
struct Weights(HashMap<String, Weight>);

impl Weights {
    fn of(graph: &Graph) -> Self {
        let weight = |tensor: &onnx::Tensor| Weight {
            elements: tensor.dims.iter().map(|dim| u64::try_from(*dim).unwrap_or(0)).product(),
            float: tensor.data_type == onnx::data_type::FLOAT,
        };
        let named = graph.initializer.iter().map(|tensor| (tensor.name.clone(), weight(tensor)));
        let constants = graph.node.iter().filter(|node| node.op_type == "Constant").filter_map(|node| {
            let tensor = node.attribute.iter().find_map(|attribute| attribute.t.as_ref())?;
            Some((node.output.first()?.clone(), weight(tensor)))
        });
        Self(named.chain(constants).collect())
    }

    /// Scalars are settings of the graph (eps, scales), not trained.
    fn parameters(&self) -> u64 {
        self.0
            .values()
            .filter(|weight| weight.float && weight.elements > 1)
            .map(|weight| weight.elements)
            .sum()
    }
}

type Shapes = HashMap<String, Vec<usize>>;

/// Shapes of all values, as tract works them out.
fn shapes(bytes: &[u8]) -> Result<Shapes, String> {
    let framework = tract_onnx::onnx();
    let text = |error: tract_onnx::prelude::TractError| format!("{error:#}");
    let proto = framework.proto_model_for_read(&mut &bytes[..]).map_err(text)?;
    let parsed = framework.parse(&proto, None).map_err(text)?;
    let mut model = parsed.model;
    model.analyse(false).map_err(text)?;
    let mut shapes = Shapes::new();
    for (name, outlet) in parsed.outlets_by_name {
        let fact = model.outlet_fact(outlet).map_err(text)?;
        let dims = fact.shape.dims().map(|dim| dim.concretize().and_then(|dim| dim.to_usize().ok()));
        if let Some(shape) = dims.collect() {
            shapes.insert(name, shape);
        }
    }
    Ok(shapes)
}

fn elements(shapes: &Shapes, name: Option<&String>) -> u64 {
    let shape = name.and_then(|name| shapes.get(name));
    shape.map_or(0, |shape| shape.iter().product::<usize>() as u64)
}

fn flops(node: &Node, shapes: &Shapes) -> u64 {
    let input = |index: usize| elements(shapes, node.input.get(index));
    let shape = |index: usize| node.input.get(index).and_then(|name| shapes.get(name));
    let output = elements(shapes, node.output.first());
    match node.op_type.as_str() {
        // Weights are [out, in / groups, kernel...]: every output element meets in / groups * kernel of them.
        "Conv" => 2 * output * shape(1).map_or(0, |w| w.iter().skip(1).product::<usize>() as u64),
        // Weights are [in, out / groups, kernel...]: every input element meets out / groups * kernel of them.
        "ConvTranspose" => 2 * input(0) * shape(1).map_or(0, |w| w.iter().skip(1).product::<usize>() as u64),
        "MatMul" | "Gemm" => 2 * output * shape(0).and_then(|a| a.last()).map_or(0, |k| *k as u64),
        "ReduceSum" | "ReduceMean" | "ReduceMax" | "ArgMax" => input(0),
        "LayerNormalization" => 8 * output,
        "Softmax" | "LogSoftmax" => 5 * output,
        "Sigmoid" | "Tanh" | "Exp" | "Log" | "Erf" => 4 * output,
        "Add" | "Sub" | "Mul" | "Div" | "Max" | "Min" | "Abs" | "Neg" | "Sqrt" | "Relu" | "Pow"
        | "Reciprocal" | "Clip" | "Where" | "Sum" => output,
        // Moving and reinterpreting data.
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use rcwm_models::onnx::{Model, OperatorSet, Tensor, ValueInfo, data_type};

    use super::*;

    /// `MatMul([1, 3] x [3, 4])`, then `Gather` of 2 rows of a [10, 4] table, added.
    fn bytes() -> Vec<u8> {
        let node = |op: &str, inputs: &[&str], output: &str| Node {
            op_type: op.into(),
            input: inputs.iter().map(|name| (*name).to_owned()).collect(),
            output: vec![output.into()],
            name: output.into(),
            ..Node::default()
        };
        let graph = Graph {
            name: "tiny".into(),
            node: vec![
                node("MatMul", &["x", "w"], "y"),
                node("Gather", &["table", "rows"], "picked"),
                node("Add", &["y", "picked"], "sum"),
            ],
            initializer: vec![
                Tensor::f32("w", &[3, 4], &[0.5; 12]),
                Tensor::f32("table", &[10, 4], &[1.0; 40]),
            ],
            input: vec![
                ValueInfo::tensor("x", data_type::FLOAT, &[1, 3]),
                ValueInfo::tensor("rows", data_type::INT64, &[2]),
            ],
            output: vec![ValueInfo::tensor("sum", data_type::FLOAT, &[2, 4])],
            ..Graph::default()
        };
        let opset_import = vec![OperatorSet { domain: String::new(), version: 17 }];
        Model { ir_version: 8, graph: Some(graph), opset_import, ..Model::default() }.encode_to_vec()
    }

    #[test]
    fn a_gather_reads_only_the_rows_it_picks() {
        let cost = Cost::of(&bytes()).unwrap();
        assert_eq!(cost.parameters, 52);
        assert_eq!(cost.flops, 2 * 3 * 4 + 8);
        assert_eq!(cost.weight_bytes, 4 * (12 + 8));
        assert_eq!(cost.operators.values().sum::<u64>(), 3);
    }
}
