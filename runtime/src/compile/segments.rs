//! The pieces of a tick that run one after another.

use std::collections::{BTreeMap, BTreeSet};

use rcwm_models::bundle::PartName;
use rcwm_models::onnx::{self, ValueInfo};

use super::graph::{Fact, Graph, TickNode};
use super::join::to_bytes;

/// A piece of the tick, as an ONNX file of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// The part it comes from.
    pub part: PartName,
    /// Whether it needs the image.
    pub late: bool,
    /// What goes in: the tick's inputs and other segments' outputs.
    pub inputs: Vec<(String, Fact)>,
    /// What comes out, with what is known of it.
    pub outputs: Vec<(String, Option<Fact>)>,
    /// The file.
    pub onnx: Vec<u8>,
    /// Operators in it, for people who ask.
    pub operators: Vec<String>,
}

/// Early segments, then late ones, each in the order of the parts.
pub(super) fn cut(graph: &Graph, parts: &[PartName]) -> Vec<Segment> {
    let places = [false, true].into_iter().flat_map(|late| parts.iter().map(move |part| (*part, late)));
    let cut = |(part, late)| segment(graph, part, late, |node| node.part == part && node.late == late);
    places.filter_map(cut).collect()
}

/// All that is early as one file, and all that is late.
pub(super) fn halve(graph: &Graph) -> Option<[Segment; 2]> {
    let half = |late| {
        let half = segment(graph, PartName::Policy, late, |node| node.late == late)?;
        half.outputs.iter().all(|(_, fact)| fact.is_some()).then_some(())?;
        Some(half)
    };
    Some([half(false)?, half(true)?])
}

fn segment(graph: &Graph, part: PartName, late: bool, mine: impl Fn(&TickNode) -> bool) -> Option<Segment> {
    let mine = |node: &&TickNode| mine(node);
    let nodes: Vec<&TickNode> = graph.nodes.iter().filter(mine).collect();
    if nodes.is_empty() {
        return None;
    }
    let made: BTreeSet<&String> = nodes.iter().flat_map(|node| &node.node.output).collect();
    let read: BTreeSet<&String> =
        nodes.iter().flat_map(|node| &node.node.input).filter(|name| !name.is_empty()).collect();
    let read_elsewhere: BTreeSet<&String> =
        graph.nodes.iter().filter(|node| !mine(node)).flat_map(|node| &node.node.input).collect();
    let inputs = read.iter().filter(|name| !made.contains(**name) && !graph.constants.contains_key(**name));
    let inputs: Vec<(String, Fact)> =
        inputs.filter_map(|name| Some(((*name).clone(), graph.facts.get(*name)?.clone()))).collect();
    let wanted = |name: &&&String| read_elsewhere.contains(**name) || graph.outputs.contains(**name);
    let outputs: Vec<(String, Option<Fact>)> =
        made.iter().filter(wanted).map(|name| ((*name).clone(), graph.facts.get(*name).cloned())).collect();
    let operators = nodes.iter().map(|node| node.node.op_type.clone()).collect();
    let constants: BTreeMap<_, _> = graph.constants.iter().filter(|(name, _)| read.contains(name)).collect();
    let value = |(name, fact): &(String, Fact)| ValueInfo::tensor(name, fact.dtype, &fact.shape);
    let file = onnx::Graph {
        name: format!("{part}.{}", if late { "late" } else { "early" }),
        node: nodes.iter().map(|node| node.node.clone()).collect(),
        initializer: constants.into_values().cloned().collect(),
        input: inputs.iter().map(value).collect(),
        output: outputs.iter().map(|(name, _)| ValueInfo { name: name.clone(), r#type: None }).collect(),
        ..onnx::Graph::default()
    };
    let of_all = || graph.opsets.values().copied().max();
    let opset = graph.opsets.get(&part).copied().or_else(of_all).unwrap_or(17);
    Some(Segment { part, late, inputs, outputs, onnx: to_bytes(file, opset), operators })
}
