//! The parts as one graph.

use std::collections::BTreeSet;

use prost::Message;
use rcwm_models::bundle::{Bundle, CARRIED, EXECUTED, PartName};
use rcwm_models::onnx::{self, Model};
use tract_onnx::prelude::{Framework, TractResult};
use tract_onnx::tract_hir::internal::{Factoid, InferenceModelExt};

use super::graph::{Fact, Graph, TickNode};
use super::{CompileError, inputs};
use crate::operators::DOMAIN;

/// Reads the parts, names their values `part/name`, and connects what goes out of one with what goes into another.
pub(super) fn join(bundle: &Bundle) -> Result<Graph, CompileError> {
    let mut graph = Graph::default();
    let mut late: BTreeSet<String> = [inputs::IMAGE, inputs::STATE].map(str::to_owned).into();
    let kind = bundle.manifest.kind;
    for part in kind.parts().iter().copied() {
        let refuse = |reason: String| CompileError::Part { part, reason };
        let bytes = bundle.part(part).ok_or_else(|| refuse("the bundle does not have it".into()))?;
        let model = onnx::parse_self_contained(bytes).map_err(|error| refuse(error.to_string()))?;
        let facts =
            facts(bytes).map_err(|error| refuse(rcwm_models::errors::on_one_line(&format!("{error:#}"))))?;
        add(&mut graph, part, model, facts);
    }
    for part in kind.parts() {
        let names: &[&str] = match part {
            PartName::Interaction => &["e", "attention"],
            PartName::Actor => &["mean", "std"],
            branch if kind.branches().contains(branch) => &OF_A_BRANCH,
            _ => &[],
        };
        graph.outputs.extend(names.iter().map(|name| format!("{part}/{name}")));
    }
    // A policy in one graph gives what its own entry says.
    if let Some(policy) = bundle.manifest.part(PartName::Policy) {
        graph.outputs.extend(policy.outputs.iter().map(|output| format!("{}/{}", policy.name, output.name)));
        let known_before = |name: &str| name == EXECUTED || name.starts_with(CARRIED);
        let names = policy.inputs.iter().map(|input| input.name.clone());
        late.extend(names.filter(|name| !known_before(name)));
    }
    mark_late(&mut graph, late);
    Ok(graph)
}

const OF_A_BRANCH: [&str; 5] = ["h_next", "prior_z", "posterior_z", "prior_log_probs", "posterior_log_probs"];

/// What a part's input is in the whole tick.
fn source(part: PartName, input: &str) -> String {
    use PartName::{Dynamics, Encoder, Environment, Interaction, Policy, Robot};
    match (part, input) {
        (Policy, own) => own.to_owned(),
        (Encoder, _) => inputs::IMAGE.into(),
        (Robot | Dynamics | Environment, "features") => "encoder/features".into(),
        (Robot | Dynamics, "action") => inputs::ACTION.into(),
        (Robot | Dynamics, "state") => inputs::STATE.into(),
        (Environment, "e") => "interaction/e".into(),
        (Robot | Dynamics | Environment, own) => inputs::of_branch(part, own),
        // The robot's PRIOR sample: the interaction is known before the image is (A.2).
        (Interaction, "robot_prior_z") => "robot/prior_z".into(),
        (Interaction, "environment_z") => inputs::of_branch(Environment, "z"),
        // A head, or the interaction: the state as it is after the tick.
        (_, input) => match input.rsplit_once('_') {
            Some((branch, "z")) => format!("{branch}/posterior_z"),
            Some((branch, _)) => format!("{branch}/h_next"),
            None => input.to_owned(),
        },
    }
}

/// Type and shape of every value of a part, as tract works them out.
fn facts(bytes: &[u8]) -> TractResult<Vec<(String, Fact)>> {
    let onnx = tract_onnx::onnx();
    let proto = onnx.proto_model_for_read(&mut &bytes[..])?;
    let mut parsed = onnx.parse(&proto, None)?;
    parsed.model.analyse(true)?;
    let mut facts = Vec::new();
    for (name, outlet) in parsed.outlets_by_name {
        let fact = parsed.model.outlet_fact(outlet)?;
        let dtype = match fact.datum_type.concretize() {
            Some(dtype) if dtype == u8::datum() => onnx::data_type::UINT8,
            Some(dtype) if dtype == i64::datum() => onnx::data_type::INT64,
            Some(dtype) if dtype == f32::datum() => onnx::data_type::FLOAT,
            // Something in between that no segment hands over.
            _ => continue,
        };
        if let Some(shape) = fact.shape.as_concrete_finite()? {
            facts.push((name, Fact { dtype, shape: shape.to_vec() }));
        }
    }
    Ok(facts)
}

/// The `datum_type` of a Rust type, shorter.
trait Datum {
    fn datum() -> tract_onnx::prelude::DatumType;
}

impl<T: tract_onnx::prelude::Datum> Datum for T {
    fn datum() -> tract_onnx::prelude::DatumType {
        T::datum_type()
    }
}

fn add(graph: &mut Graph, part: PartName, model: Model, facts: Vec<(String, Fact)>) {
    let opset = model.opset_import.iter().map(|set| set.version).max().unwrap_or(17);
    graph.opsets.insert(part, opset);
    let Some(file) = model.graph else { return };
    let constants: BTreeSet<String> = file.initializer.iter().map(|tensor| tensor.name.clone()).collect();
    let fed: BTreeSet<String> =
        file.input.iter().map(|input| input.name.clone()).filter(|name| !constants.contains(name)).collect();
    let global = |name: &str| match name {
        // An optional input that is left out.
        "" => String::new(),
        name if fed.contains(name) => source(part, name),
        name => format!("{part}/{name}"),
    };
    for mut tensor in file.initializer {
        tensor.name = global(&tensor.name);
        graph.constants.insert(tensor.name.clone(), tensor);
    }
    for (name, fact) in facts {
        if !constants.contains(&name) {
            graph.facts.insert(global(&name), fact);
        }
    }
    for mut node in file.node {
        node.input.iter_mut().chain(&mut node.output).for_each(|name| *name = global(name));
        node.name = format!("{part}/{}", node.name);
        let constant =
            node.attribute.iter().find(|attribute| attribute.name == "value").and_then(|a| a.t.clone());
        match (node.op_type.as_str(), constant) {
            ("Constant", Some(mut tensor)) if !tensor.raw_data.is_empty() => {
                tensor.name.clone_from(&node.output[0]);
                graph.constants.insert(tensor.name.clone(), tensor);
            }
            _ => graph.nodes.push(TickNode { part, late: false, node }),
        }
    }
}

/// What depends on anything of `late` is late as well.
fn mark_late(graph: &mut Graph, mut late: BTreeSet<String>) {
    for node in &mut graph.nodes {
        node.late = node.node.input.iter().any(|input| late.contains(input));
        if node.late {
            late.extend(node.node.output.iter().cloned());
        }
    }
}

/// A model of one graph, as a file.
pub(super) fn to_bytes(graph: onnx::Graph, opset: i64) -> Vec<u8> {
    let set = |domain: &str, version| onnx::OperatorSet { domain: domain.into(), version };
    let ours = graph.node.iter().any(|node| node.domain == DOMAIN);
    let mut opset_import = vec![set("", opset)];
    opset_import.extend(ours.then(|| set(DOMAIN, 1)));
    Model { ir_version: 8, graph: Some(graph), opset_import, ..Model::default() }.encode_to_vec()
}
