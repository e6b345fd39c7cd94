//! A part's graph, checked before any engine sees it: what it does, how large every value is, and that no index leaves its table.
//!
//! Engines are written for files of well-meaning exporters; a damaged or hostile one can make them abort, index out of bounds or ask
//! for all memory there is. So every node must be one of a short list of operators, with attributes and inputs of known form; the
//! type and shape of every value are worked out here, and for integers also the range of their values. What does not fit, or
//! is larger than [`Limits`] allows, is refused with the node's name.

mod attributes;
mod inferred;
mod movement;
mod operators;
mod policies;
mod value;
mod window;

use std::collections::HashMap;

use super::{DType, TensorSpec};
use crate::onnx::{Amounts, Graph, Model, Node, Tensor, ValueInfo};
use attributes::Attributes;
use value::Value;

/// Operator sets whose operators mean what is checked here.
const OPSETS: std::ops::RangeInclusive<i64> = 17..=21;

/// What a part may hold at most, beside [`Amounts`]. The paper's largest part has 4 million elements between its nodes.
struct Limits;

impl Limits {
    const RANK: usize = 6;
    /// All values between the nodes together, and what a convolution unfolds its input to: 64 MiB as f32.
    const ELEMENTS: usize = 1 << 24;
}

/// Why a graph was refused.
#[derive(Debug, thiserror::Error)]
pub enum GraphError {
    /// Written for other operators.
    #[error(
        "operator sets {found:?}, expected the standard one, version {} to {}; export with opset 17",
        OPSETS.start(),
        OPSETS.end()
    )]
    OperatorSet {
        /// Versions of the sets named.
        found: Vec<i64>,
    },
    /// More of something than any part has.
    #[error("{what}: {found}, at most {max} are accepted")]
    TooLarge {
        /// What there is too much of.
        what: String,
        /// How much there is.
        found: usize,
        /// The limit.
        max: usize,
    },
    /// A name that is missing, unknown or taken.
    #[error("value {name:?} {problem}")]
    Name {
        name: String,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// A constant whose contents are not what its shape and type say.
    #[error("constant {name:?} {problem}")]
    Constant {
        /// The constant.
        name: String,
        /// What is wrong with it.
        problem: String,
    },
    /// An operator that is not on the list.
    #[error("node {node:?}: operator {operator:?} is not one that a part may use")]
    Operator { node: String, operator: String },
    /// A node whose attributes or inputs do not fit its operator.
    #[error("node {node:?} ({operator}): {reason}")]
    Node {
        node: String,
        operator: String,
        /// What does not fit.
        reason: String,
    },
    /// An output that may be no class: an index out of bounds in the next part.
    #[error("output {name:?} may hold {}, expected classes 0 to {class_max}", between(*.range))]
    Range {
        /// The output.
        name: String,
        /// Smallest and largest value that it may hold, as far as that is known.
        range: Option<(i64, i64)>,
        /// The largest class.
        class_max: i64,
    },
    /// A value is not what the file says of it.
    #[error("value {name:?} is {found}, the file says {expected}")]
    Value {
        /// The value.
        name: String,
        found: String,
        /// What it is said to be.
        expected: String,
    },
}

fn between(range: Option<(i64, i64)>) -> String {
    range.map_or_else(|| "any integer".into(), |(min, max)| format!("integers from {min} to {max}"))
}

/// Checks a part. `classes` is m: integers that enter are class indices, 0 to m - 1, and so are those that leave, whatever enters: they
/// are the next part's.
pub(super) fn check(
    model: &Model,
    inputs: &[TensorSpec],
    outputs: &[TensorSpec],
    classes: usize,
) -> Result<(), GraphError> {
    check_opset(model)?;
    let Some(graph) = &model.graph else { return Ok(()) };
    at_most("nodes", graph.node.len(), Amounts::NODES)?;
    at_most("constants", graph.initializer.len(), Amounts::CONSTANTS)?;
    let mut walk = Walk::default();
    let class_max = classes.saturating_sub(1) as i64;
    for spec in inputs {
        let range = (spec.dtype == DType::I64).then_some((0, class_max));
        walk.define(&spec.name, Value { range, ..Value::new(spec.dtype, spec.shape.clone()) })?;
    }
    for tensor in &graph.initializer {
        walk.define(&tensor.name, constant(tensor)?)?;
    }
    for node in &graph.node {
        walk.run(node)?;
    }
    for spec in outputs {
        let said = Value::new(spec.dtype, spec.shape.clone());
        walk.compare(&spec.name, &said)?;
        walk.check_range(&spec.name, class_max)?;
    }
    walk.check_claims(graph)
}

fn check_opset(model: &Model) -> Result<(), GraphError> {
    let found: Vec<i64> = model.opset_import.iter().map(|set| set.version).collect();
    match found.as_slice() {
        [version] if OPSETS.contains(version) => Ok(()),
        _ => Err(GraphError::OperatorSet { found }),
    }
}

fn at_most(what: &str, found: usize, max: usize) -> Result<(), GraphError> {
    if found <= max { Ok(()) } else { Err(GraphError::TooLarge { what: what.to_owned(), found, max }) }
}

/// The values known so far.
#[derive(Default)]
struct Walk {
    values: HashMap<String, Value>,
    /// Elements of all values that nodes have made.
    elements: usize,
}

impl Walk {
    fn define(&mut self, name: &str, value: Value) -> Result<(), GraphError> {
        let wrong = |problem| Err(GraphError::Name { name: name.to_owned(), problem });
        if name.is_empty() {
            return wrong("has no name");
        }
        at_most("bytes in a name", name.len(), Amounts::NAME_BYTES)?;
        if self.values.insert(name.to_owned(), value).is_some() {
            return wrong("is defined twice");
        }
        Ok(())
    }

    fn value(&self, name: &str) -> Result<&Value, GraphError> {
        let problem = "is used, but nothing before gives it";
        self.values.get(name).ok_or_else(|| GraphError::Name { name: name.to_owned(), problem })
    }

    fn run(&mut self, node: &Node) -> Result<(), GraphError> {
        at_most("inputs of a node", node.input.len(), Amounts::NODE_INPUTS)?;
        let absent = Value::absent();
        let may_be_absent = policies::WITH_OPTIONAL_INPUTS.contains(&node.op_type.as_str());
        let value = |name: &String| match name.as_str() {
            "" if may_be_absent => Ok(&absent),
            name => self.value(name),
        };
        let inputs = node.input.iter().map(value).collect::<Result<Vec<_>, _>>()?;
        let failed =
            |reason| GraphError::Node { node: node.name.clone(), operator: node.op_type.clone(), reason };
        let mut attributes = Attributes::of(node).map_err(failed)?;
        let outputs = operators::infer(&node.op_type, &mut attributes, &inputs, node.output.len());
        let Some(outputs) = outputs else {
            return Err(GraphError::Operator { node: node.name.clone(), operator: node.op_type.clone() });
        };
        let outputs = outputs.map_err(failed)?;
        attributes.all_read().map_err(failed)?;
        if outputs.len() != node.output.len() {
            let (found, expected) = (node.output.len(), outputs.len());
            return Err(failed(format!("{found} outputs, expected {expected}")));
        }
        // One that has no name is not wanted, which only operators with several may say.
        let unwanted = |name: &String| name.is_empty() && may_be_absent;
        for (name, value) in node.output.iter().zip(outputs).filter(|(name, _)| !unwanted(name)) {
            value.check(Limits::RANK).map_err(failed)?;
            // Each was checked to be small: the sum of two cannot overflow.
            self.elements += value.elements().min(Limits::ELEMENTS + 1);
            at_most("elements of all values together", self.elements, Limits::ELEMENTS)?;
            self.define(name, value)?;
        }
        Ok(())
    }

    fn compare(&self, name: &str, said: &Value) -> Result<(), GraphError> {
        let found = self.value(name)?;
        if found.dtype == said.dtype && found.shape == said.shape {
            return Ok(());
        }
        let (found, expected) = (found.text(), said.text());
        Err(GraphError::Value { name: name.to_owned(), found, expected })
    }

    /// Integers that leave the part are classes.
    fn check_range(&self, name: &str, class_max: i64) -> Result<(), GraphError> {
        let found = self.value(name)?;
        match (found.dtype, found.range) {
            (DType::I64, Some((min, max))) if min >= 0 && max <= class_max => Ok(()),
            (DType::I64, range) => Err(GraphError::Range { name: name.to_owned(), range, class_max }),
            _ => Ok(()),
        }
    }

    /// What the file says of values in between: engines read it, so it must be true.
    fn check_claims(&self, graph: &Graph) -> Result<(), GraphError> {
        for claim in &graph.value_info {
            let said = claimed(claim).ok_or_else(|| GraphError::Name {
                name: claim.name.clone(),
                problem: "is described without type or fixed shape",
            })?;
            self.compare(&claim.name, &said)?;
        }
        Ok(())
    }
}

fn claimed(info: &ValueInfo) -> Option<Value> {
    let (elem_type, shape) = info.fixed()?;
    Some(Value::new(DType::from_onnx(elem_type)?, shape))
}

fn constant(tensor: &Tensor) -> Result<Value, GraphError> {
    let wrong = |problem| GraphError::Constant { name: tensor.name.clone(), problem };
    Value::constant(tensor, Limits::RANK).map_err(wrong)
}

#[cfg(test)]
mod tests;
