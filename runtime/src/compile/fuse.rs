//! Groups of nodes that are hot become one node of our own.
//!
//! A group is taken only where all its values but the last are read nowhere else, and where all its nodes run in the same segment: what can be
//! known before the image stays before it.

mod convolution;
mod latents;
mod layer;
mod layout;
mod norm;

use rcwm_models::onnx::{Attribute, Node};

use super::Optimizations;
use super::graph::{Fact, Graph, int_attribute, ints_attribute};
use crate::operators::{DOMAIN, LAYER};

/// Applies what is asked for.
pub(super) fn fuse(graph: &mut Graph, optimizations: Optimizations) {
    if optimizations.norms {
        norm::fuse(graph);
    }
    if optimizations.norms && optimizations.convolutions {
        convolution::fuse(graph);
        layout::cancel_transposes(graph);
        convolution::read_bytes(graph);
        layout::flatten_channels_last(graph);
    }
    if optimizations.layers {
        layer::fuse(graph);
        latents::fuse(graph);
    }
    if optimizations.half_weights {
        let ours = graph.nodes.iter_mut().filter(|node| node.node.op_type == LAYER);
        ours.for_each(|node| node.node.attribute.push(int_attribute("half", 1)));
    }
    graph.drop_unused();
}

/// Tries a rewriting at every node until none applies any more.
fn everywhere(graph: &mut Graph, mut rewrite: impl FnMut(&mut Graph, usize) -> Option<()>) {
    let mut index = 0;
    while index < graph.nodes.len() {
        if rewrite(graph, index).is_some() {
            // Nodes may have gone: look at all of them again.
            index = 0;
        } else {
            index += 1;
        }
    }
}

/// A node of ours in place of the node at `index`, with its output, and without the nodes in `absorbed`.
fn replace(
    graph: &mut Graph,
    index: usize,
    absorbed: &[usize],
    operator: &str,
    inputs: Vec<String>,
    mut attribute: Vec<Attribute>,
) {
    let old = &mut graph.nodes[index].node;
    let shape = old.output.first().and_then(|output| graph.facts.get(output)).map(|fact| &fact.shape);
    let shape: Vec<i64> = shape.into_iter().flatten().map(|size| *size as i64).collect();
    attribute.retain(|attribute| attribute.name != "shape");
    attribute.push(ints_attribute("shape", &shape));
    *old = Node {
        op_type: operator.to_owned(),
        input: inputs,
        output: std::mem::take(&mut old.output),
        name: std::mem::take(&mut old.name),
        domain: DOMAIN.to_owned(),
        attribute,
    };
    let mut absorbed = absorbed.to_vec();
    absorbed.sort_unstable();
    for index in absorbed.into_iter().rev() {
        let node = graph.nodes.remove(index);
        node.node.output.iter().for_each(|output| drop(graph.facts.remove(output)));
    }
}

/// A new value of this type and shape.
fn new_value(graph: &mut Graph, name: &str, dtype: i32, shape: &[usize]) -> String {
    let name = graph.new_name(name);
    graph.facts.insert(name.clone(), Fact { dtype, shape: shape.to_vec() });
    name
}
