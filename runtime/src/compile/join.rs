//! The parts as one graph.

use std::collections::BTreeSet;

use prost::Message;
use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::onnx::{self, Model};
use tract_onnx::prelude::{Framework, TractResult};
use tract_onnx::tract_hir::internal::{Factoid, InferenceModelExt};

use super::graph::{Fact, Graph, TickNode};
use super::{CompileError, inputs};
use crate::operators::DOMAIN;

/// Reads the parts, names their values `part/name`, and connects what goes out of one with what goes into another.
pub(super) fn join(bundle: &Bundle) -> Result<Graph, CompileError> {
    let mut graph = Graph::default();
    for part in PartName::REQUIRED {
        let refuse = |reason: String| CompileError::Part { part, reason };
        let bytes = bundle.part(part).ok_or_else(|| refuse("the bundle does not have it".into()))?;
        let model = onnx::parse_self_contained(bytes).map_err(|error| refuse(error.to_string()))?;
        let facts =
            facts(bytes).map_err(|error| refuse(rcwm_models::errors::on_one_line(&format!("{error:#}"))))?;
        add(&mut graph, part, model, facts);
    }
    for (part, names) in [
        (PartName::Robot, OF_A_BRANCH.as_slice()),
        (PartName::Environment, &OF_A_BRANCH),
        (PartName::Interaction, &["e", "attention"]),
        (PartName::Actor, &["mean", "std"]),
    ] {
        graph.outputs.extend(names.iter().map(|name| format!("{part}/{name}")));
    }
    mark_late(&mut graph);
    Ok(graph)
}

const OF_A_BRANCH: [&str; 5] = ["h_next", "prior_z", "posterior_z", "prior_log_probs", "posterior_log_probs"];

/// What a part's input is in the whole tick.
fn source(part: PartName, input: &str) -> String {
    let own = |name: &str| name.to_owned();
    match (part, input) {
        (PartName::Encoder, _) => own(inputs::IMAGE),
        (PartName::Robot | PartName::Environment, "features") => "encoder/features".into(),
        (PartName::Robot, "action") => own(inputs::ACTION),
        (PartName::Robot, "state") => own(inputs::STATE),
        (PartName::Robot, "noise") => own(inputs::ROBOT_NOISE),
        (PartName::Robot, "z") => own(inputs::ROBOT_Z),
        (PartName::Robot, _) => own(inputs::ROBOT_H),
        // The robot's PRIOR sample: the interaction is known before the image is (A.2).
        (PartName::Interaction, "robot_prior_z") => "robot/prior_z".into(),
        (PartName::Interaction | PartName::Actor, "robot_h") => "robot/h_next".into(),
        (PartName::Interaction, _) => own(inputs::ENVIRONMENT_Z),
        (PartName::Environment, "e") => "interaction/e".into(),
        (PartName::Environment, "noise") => own(inputs::ENVIRONMENT_NOISE),
        (PartName::Environment, _) => own(inputs::ENVIRONMENT_H),
        (_, "robot_z") => "robot/posterior_z".into(),
        (_, "environment_z") => "environment/posterior_z".into(),
        _ => "environment/h_next".into(),
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

fn mark_late(graph: &mut Graph) {
    let mut late: BTreeSet<String> = [inputs::IMAGE, inputs::STATE].map(str::to_owned).into();
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
