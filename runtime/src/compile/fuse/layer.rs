//! A layer: the sum of products, of table rows and of what else is added, then norm and `SiLU`.

use rcwm_models::onnx::{Attribute, attribute_type};

use super::super::graph::{Graph, TickNode, attribute, int};
use super::{everywhere, replace};
use crate::operators::{LAYER, NORM, Term};

pub(super) fn fuse(graph: &mut Graph) {
    everywhere(graph, product);
    everywhere(graph, one_hot_product);
    everywhere(graph, sum);
    everywhere(graph, norm);
}

/// The attributes of a layer.
fn attributes(terms: &[Term], mut others: Vec<Attribute>) -> Vec<Attribute> {
    let text = terms.iter().map(|term| term.letter()).collect::<String>();
    let s = text.into_bytes();
    others.push(Attribute {
        name: "terms".into(),
        s,
        r#type: attribute_type::STRING,
        ..Attribute::default()
    });
    others
}

fn terms(node: &TickNode) -> Option<Vec<Term>> {
    if node.node.op_type != LAYER {
        return None;
    }
    attribute(&node.node, "terms")?.s.iter().map(|letter| Term::of_letter(*letter)).collect()
}

/// One row times a constant matrix.
fn product(graph: &mut Graph, index: usize) -> Option<()> {
    let [x, weight] = graph.inputs(index) else { return None };
    let fits = graph.operator(index) == "MatMul" && graph.is_row(x) && graph.floats(weight).is_some();
    if !fits || graph.constant_shape(weight)?.len() != 2 {
        return None;
    }
    let inputs = vec![x.clone(), weight.clone()];
    replace(graph, index, &[], LAYER, inputs, attributes(&[Term::Product], vec![]));
    Some(())
}

/// The sum of one table row per latent.
fn one_hot_product(graph: &mut Graph, index: usize) -> Option<()> {
    let node = &graph.nodes[index].node;
    let [rows, axes] = node.input.as_slice() else { return None };
    let over_latents = graph.integers(axes).is_some_and(|axes| axes == [1]);
    if node.op_type != "ReduceSum" || !over_latents || int(node, "keepdims") != Some(0) {
        return None;
    }
    let gather = graph.absorbable(index, rows, "Gather")?;
    let [table, row_index] = graph.inputs(gather) else { return None };
    let add = graph.absorbable(gather, row_index, "Add")?;
    let [z, offsets] = graph.inputs(add) else { return None };
    let fits = graph.floats(table).is_some()
        && graph.constant_shape(table)?.len() == 2
        && graph.is_row(z)
        && graph
            .integers(offsets)
            .is_some_and(|offsets| graph.shape(z).is_some_and(|z| z[1] == offsets.len()))
        && int(&graph.nodes[gather].node, "axis").unwrap_or(0) == 0;
    if !fits {
        return None;
    }
    let inputs = vec![z.clone(), offsets.clone(), table.clone()];
    replace(graph, index, &[add, gather], LAYER, inputs, attributes(&[Term::Rows], vec![]));
    Some(())
}

/// A sum of two, of which at least one is a layer without a norm.
fn sum(graph: &mut Graph, index: usize) -> Option<()> {
    let [a, b] = graph.inputs(index) else { return None };
    if graph.operator(index) != "Add" || !graph.is_row(&graph.nodes[index].node.output[0]) {
        return None;
    }
    let (mut all, mut inputs, mut absorbed) = (Vec::new(), Vec::new(), Vec::new());
    for value in [a, b] {
        let layer = graph
            .absorbable(index, value, LAYER)
            .filter(|layer| attribute(&graph.nodes[*layer].node, "epsilon").is_none());
        match layer {
            Some(layer) => {
                all.extend(terms(&graph.nodes[layer])?);
                inputs.extend_from_slice(graph.inputs(layer));
                absorbed.push(layer);
            }
            None => {
                all.push(Term::Value);
                inputs.push(value.clone());
            }
        }
    }
    let width = graph.shape(&graph.nodes[index].node.output[0])?[1];
    let whole = |value: &String| {
        let constant = graph.floats(value).map(|values| values.len());
        constant.or_else(|| graph.shape(value).map(|shape| shape.iter().product())) == Some(width)
    };
    let values_fit = [a, b].into_iter().all(whole);
    if absorbed.is_empty() || !values_fit {
        return None;
    }
    replace(graph, index, &absorbed, LAYER, inputs, attributes(&all, vec![]));
    Some(())
}

/// A norm behind a layer.
fn norm(graph: &mut Graph, index: usize) -> Option<()> {
    if graph.operator(index) != NORM {
        return None;
    }
    let [x, gain, shift] = graph.inputs(index) else { return None };
    let layer = graph.absorbable(index, x, LAYER)?;
    let node = &graph.nodes[layer];
    let terms = terms(node)?;
    if attribute(&node.node, "epsilon").is_some() {
        return None;
    }
    let inputs = graph.inputs(layer).iter().chain([gain, shift]).cloned().collect();
    let others = graph.nodes[index].node.attribute.clone();
    replace(graph, index, &[layer], LAYER, inputs, attributes(&terms, others));
    Some(())
}
