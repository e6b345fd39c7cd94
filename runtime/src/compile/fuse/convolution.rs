//! Convolution, norm over channels and `SiLU`, channels last.

use rcwm_models::onnx::{Node, data_type};

use super::super::graph::{Graph, float_attribute, int, ints, ints_attribute};
use super::{everywhere, new_value, replace};
use crate::operators::{CONV, NORM};
use rcwm_kernels::tick::conv::Conv;

const TO_LAST: [i64; 4] = [0, 2, 3, 1];
const TO_FIRST: [i64; 4] = [0, 3, 1, 2];

pub(super) fn fuse(graph: &mut Graph) {
    everywhere(graph, convolution);
}

/// `norm(transpose(conv(x)))` becomes `ours(transpose(x))`.
fn convolution(graph: &mut Graph, index: usize) -> Option<()> {
    if graph.operator(index) != NORM {
        return None;
    }
    let [normed, gain, shift] = graph.inputs(index) else { return None };
    let transpose = graph.absorbable(index, normed, "Transpose")?;
    let order = ints(&graph.nodes[transpose].node, "perm");
    let conv = graph.absorbable(transpose, graph.inputs(transpose).first()?, "Conv")?;
    let [x, weight] = graph.inputs(conv) else { return None };
    let [1, channels_in, side, width] = *graph.shape(x)? else { return None };
    let [channels_out, _, 4, 4] = *graph.constant_shape(weight)? else { return None };
    let node = &graph.nodes[conv].node;
    let plain = ints(node, "strides") == Some(&[2, 2])
        && ints(node, "pads") == Some(&[1, 1, 1, 1])
        && ints(node, "dilations").is_none_or(|dilations| dilations == [1, 1])
        && int(node, "group").is_none_or(|group| group == 1);
    let known =
        side == width && Conv::fits(channels_in, channels_out, side) && graph.floats(weight).is_some();
    if order != Some(&TO_LAST) || !plain || !known || !graph.same_segment(index, conv) {
        return None;
    }
    let (x, inputs) = (x.clone(), [weight.clone(), gain.clone(), shift.clone()]);
    let attributes = graph.nodes[index].node.attribute.clone();
    // The convolution's node makes room for the transposition of what goes in.
    let last = new_value(graph, &format!("{x}.last"), data_type::FLOAT, &[1, side, side, channels_in]);
    graph.nodes[conv].node = transposition(&x, &last, &TO_LAST);
    let inputs = [last].into_iter().chain(inputs).collect();
    replace(graph, index, &[transpose], CONV, inputs, attributes);
    Some(())
}

fn transposition(from: &str, to: &str, order: &[i64]) -> Node {
    Node {
        op_type: "Transpose".into(),
        input: vec![from.to_owned()],
        output: vec![to.to_owned()],
        name: format!("transpose {to}"),
        attribute: vec![ints_attribute("perm", order)],
        ..Node::default()
    }
}

/// `ours(add(div(cast(bytes))))` reads the bytes itself.
pub(super) fn read_bytes(graph: &mut Graph) {
    everywhere(graph, |graph, index| {
        if graph.operator(index) != CONV {
            return None;
        }
        let add = graph.absorbable(index, graph.inputs(index).first()?, "Add")?;
        let (shift, divided) = graph.scalar_and_other(add)?;
        let div = graph.absorbable(add, divided, "Div")?;
        let [cast_value, divisor] = graph.inputs(div) else { return None };
        let divisor = graph.scalar(divisor)?;
        let cast = graph.absorbable(div, cast_value, "Cast")?;
        let bytes = graph.inputs(cast).first()?.clone();
        if graph.facts.get(&bytes)?.dtype != data_type::UINT8 {
            return None;
        }
        let mut inputs = graph.inputs(index).to_vec();
        inputs[0] = bytes;
        let mut attributes = graph.nodes[index].node.attribute.clone();
        attributes.extend([float_attribute("divisor", divisor), float_attribute("shift", shift)]);
        replace(graph, index, &[add, div, cast], CONV, inputs, attributes);
        Some(())
    });
}

/// Whether a node turns channels first into channels last or back.
pub(super) fn is_transposition(node: &Node, to_last: bool) -> bool {
    let order = if to_last { &TO_LAST } else { &TO_FIRST };
    node.op_type == "Transpose" && ints(node, "perm") == Some(order)
}
