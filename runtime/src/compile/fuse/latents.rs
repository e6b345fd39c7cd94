//! What is done with logits.

use super::super::graph::{Graph, float_attribute, int, int_attribute};
use super::{everywhere, replace};
use crate::operators::{DRAW, LOG_PROBS};

pub(super) fn fuse(graph: &mut Graph) {
    everywhere(graph, log_probs);
    everywhere(graph, draw);
}

/// `log(softmax(reshape(x)) * factor + offset)`.
fn log_probs(graph: &mut Graph, index: usize) -> Option<()> {
    if graph.operator(index) != "Log" {
        return None;
    }
    let add = graph.absorbable(index, graph.inputs(index).first()?, "Add")?;
    let (offset, scaled) = graph.scalar_and_other(add)?;
    let mul = graph.absorbable(add, scaled, "Mul")?;
    let (factor, p) = graph.scalar_and_other(mul)?;
    let softmax = graph.absorbable(mul, p, "Softmax")?;
    let logits = graph.inputs(softmax).first()?;
    let reshape = graph.absorbable(softmax, logits, "Reshape")?;
    // What is below the smallest normal number is not what the logarithm is made for.
    if !graph.is_last_axis(softmax, -1, logits) || offset < f32::MIN_POSITIVE || factor < 0.0 {
        return None;
    }
    let attributes = vec![float_attribute("factor", factor), float_attribute("offset", offset)];
    let inputs = vec![graph.inputs(reshape).first()?.clone()];
    replace(graph, index, &[add, mul, softmax, reshape], LOG_PROBS, inputs, attributes);
    Some(())
}

/// `argmax(log_probs + noise)`.
fn draw(graph: &mut Graph, index: usize) -> Option<()> {
    let node = &graph.nodes[index].node;
    let first = int(node, "select_last_index").unwrap_or(0) == 0;
    if node.op_type != "ArgMax" || !first || int(node, "keepdims") != Some(0) {
        return None;
    }
    let scores = node.input.first()?;
    let add = graph.absorbable(index, scores, "Add")?;
    let [a, b] = graph.inputs(add) else { return None };
    let log_probs = [a, b]
        .into_iter()
        .find(|value| graph.producer(value).is_some_and(|producer| graph.operator(producer) == LOG_PROBS))?;
    let noise = if log_probs == a { b } else { a };
    let shape = graph.shape(log_probs)?;
    let same = graph
        .shape(noise)
        .is_some_and(|noise| noise.iter().product::<usize>() == shape.iter().product::<usize>());
    let [1, _, classes] = *shape else { return None };
    if !same || !graph.is_last_axis(index, 0, scores) {
        return None;
    }
    let inputs = vec![log_probs.clone(), noise.clone()];
    replace(graph, index, &[add], DRAW, inputs, vec![int_attribute("classes", classes as i64)]);
    Some(())
}
