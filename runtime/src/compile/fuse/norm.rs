//! LayerNorm over the last dimension, and `x * sigmoid(x)` behind it.

use super::super::graph::{Graph, float, float_attribute, int_attribute};
use super::{everywhere, replace};
use crate::operators::NORM;

pub(super) fn fuse(graph: &mut Graph) {
    everywhere(graph, layer_norm);
    everywhere(graph, silu);
}

fn layer_norm(graph: &mut Graph, index: usize) -> Option<()> {
    let node = &graph.nodes[index].node;
    let [x, gain, shift] = node.input.as_slice() else { return None };
    let whole =
        node.op_type == "LayerNormalization" && node.output.len() == 1 && graph.is_last_axis(index, -1, x);
    let width = *graph.shape(x)?.last()?;
    let constant = |name: &str| graph.floats(name).is_some_and(|values| values.len() == width);
    if !(whole && constant(gain) && constant(shift)) {
        return None;
    }
    let attributes =
        vec![float_attribute("epsilon", float(node, "epsilon").unwrap_or(1e-5)), int_attribute("silu", 0)];
    replace(graph, index, &[], NORM, node.input.clone(), attributes);
    Some(())
}

fn silu(graph: &mut Graph, index: usize) -> Option<()> {
    let [a, b] = graph.inputs(index) else { return None };
    if graph.operator(index) != "Mul" {
        return None;
    }
    let (normed, sigmoid) = [(a, b), (b, a)].into_iter().find_map(|(x, gate)| {
        Some((x, graph.absorbable(index, gate, "Sigmoid").filter(|s| graph.inputs(*s) == [x.clone()])?))
    })?;
    // Read by the sigmoid and by the product.
    let norm =
        graph.producer(normed).filter(|norm| graph.uses(normed) == 2 && graph.operator(*norm) == NORM)?;
    if !graph.same_segment(index, norm) {
        return None;
    }
    let inputs = graph.inputs(norm).to_vec();
    let epsilon = float(&graph.nodes[norm].node, "epsilon")?;
    let attributes = vec![float_attribute("epsilon", epsilon), int_attribute("silu", 1)];
    replace(graph, index, &[norm, sigmoid], NORM, inputs, attributes);
    Some(())
}
