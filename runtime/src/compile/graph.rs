//! The whole tick as one graph of ONNX nodes.

use std::collections::{BTreeMap, BTreeSet};

use rcwm_models::bundle::PartName;
use rcwm_models::onnx::{Attribute, Node, Tensor, attribute_type, data_type};

/// Type and shape of a value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fact {
    /// See [`data_type`].
    pub dtype: i32,
    pub shape: Vec<usize>,
}

/// A node, the part it comes from, and whether it depends on the image.
#[derive(Debug, Clone, PartialEq)]
pub struct TickNode {
    pub part: PartName,
    /// Whether it depends on the image.
    pub late: bool,
    pub node: Node,
}

/// Nodes in topological order, constants, and what is known of the values.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// In topological order.
    pub nodes: Vec<TickNode>,
    /// By name.
    pub constants: BTreeMap<String, Tensor>,
    /// Of every value but the constants.
    pub facts: BTreeMap<String, Fact>,
    /// What is wanted.
    pub outputs: BTreeSet<String>,
    /// Operator set of each part.
    pub opsets: BTreeMap<PartName, i64>,
}

impl Graph {
    /// Index of the node that makes a value.
    pub fn producer(&self, value: &str) -> Option<usize> {
        self.nodes.iter().position(|node| node.node.output.iter().any(|output| output == value))
    }

    /// How often a value is read, being wanted included.
    pub fn uses(&self, value: &str) -> usize {
        let reads =
            self.nodes.iter().flat_map(|node| &node.node.input).filter(|input| *input == value).count();
        reads + usize::from(self.outputs.contains(value))
    }

    /// The floats of a constant.
    pub fn floats(&self, value: &str) -> Option<Vec<f32>> {
        let tensor = self.constants.get(value).filter(|tensor| tensor.data_type == data_type::FLOAT)?;
        Some(tensor.raw_data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    /// The integers of a constant.
    pub fn integers(&self, value: &str) -> Option<Vec<i64>> {
        let tensor = self.constants.get(value).filter(|tensor| tensor.data_type == data_type::INT64)?;
        Some(tensor.raw_data.as_chunks::<8>().0.iter().map(|bytes| i64::from_le_bytes(*bytes)).collect())
    }

    /// The one float of a constant that holds one.
    pub fn scalar(&self, value: &str) -> Option<f32> {
        self.floats(value).filter(|values| values.len() == 1).map(|values| values[0])
    }

    pub fn constant_shape(&self, value: &str) -> Option<Vec<usize>> {
        self.constants.get(value)?.dims.iter().map(|dim| usize::try_from(*dim).ok()).collect()
    }

    /// Shape of a value.
    pub fn shape(&self, value: &str) -> Option<&[usize]> {
        self.facts.get(value).map(|fact| fact.shape.as_slice())
    }

    /// Adds a constant under a new name that begins with `name`.
    pub fn add_floats(&mut self, name: &str, shape: &[usize], values: &[f32]) -> String {
        let name = self.new_name(name);
        self.constants.insert(name.clone(), Tensor::f32(&name, shape, values));
        name
    }

    /// A name that no value has.
    pub fn new_name(&self, name: &str) -> String {
        let taken = |name: &String| self.constants.contains_key(name) || self.facts.contains_key(name);
        (0..).map(|index| format!("{name}#{index}")).find(|name| !taken(name)).unwrap_or_default()
    }

    /// Replaces every use of a value by another.
    pub fn rename_uses(&mut self, from: &str, to: &str) {
        for input in self.nodes.iter_mut().flat_map(|node| &mut node.node.input) {
            if input == from {
                to.clone_into(input);
            }
        }
    }

    /// Drops nodes whose results nobody reads.
    pub fn drop_unused(&mut self) {
        while let Some(index) = (0..self.nodes.len()).rev().find(|index| {
            let outputs = &self.nodes[*index].node.output;
            outputs.iter().all(|output| self.uses(output) == 0)
        }) {
            self.nodes.remove(index);
        }
    }
}

pub fn attribute<'a>(node: &'a Node, name: &str) -> Option<&'a Attribute> {
    node.attribute.iter().find(|attribute| attribute.name == name)
}

/// An integer attribute.
pub fn int(node: &Node, name: &str) -> Option<i64> {
    attribute(node, name).map(|attribute| attribute.i)
}

/// A list of integers.
pub fn ints<'a>(node: &'a Node, name: &str) -> Option<&'a [i64]> {
    attribute(node, name).map(|attribute| attribute.ints.as_slice())
}

/// A float attribute.
pub fn float(node: &Node, name: &str) -> Option<f32> {
    attribute(node, name).map(|attribute| attribute.f)
}

/// Makes a float attribute.
pub fn float_attribute(name: &str, f: f32) -> Attribute {
    Attribute { name: name.into(), f, r#type: attribute_type::FLOAT, ..Attribute::default() }
}

/// Makes an integer attribute.
pub fn int_attribute(name: &str, i: i64) -> Attribute {
    Attribute { name: name.into(), i, r#type: attribute_type::INT, ..Attribute::default() }
}

/// Makes a list of integers.
pub fn ints_attribute(name: &str, ints: &[i64]) -> Attribute {
    Attribute { name: name.into(), ints: ints.to_vec(), r#type: attribute_type::INTS, ..Attribute::default() }
}
