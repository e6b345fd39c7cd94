//! Another library's graph in our names: inputs and outputs renamed, a batch of 1, nothing else changed.

use rcwm_models::bundle::{CARRIED, CARRIED_NEXT, DType, PartEntry, TensorSpec};
use rcwm_models::interface::Interface;
use rcwm_models::onnx::{Graph, ValueInfo};

use super::{BundlingError, Request};

/// Gives inputs and outputs the names that were asked for.
pub(super) fn rename(graph: &mut Graph, request: &Request) -> Result<(), BundlingError> {
    // Files of older versions list constants among the inputs.
    let constants: Vec<String> = graph.initializer.iter().map(|tensor| tensor.name.clone()).collect();
    graph.input.retain(|input| !constants.contains(&input.name));
    for (from, to) in &request.rename {
        let known = graph.input.iter().chain(&graph.output).any(|info| info.name == *from);
        if !known {
            return Err(unknown(
                "--rename",
                from,
                "input or output",
                graph.input.iter().chain(&graph.output),
            ));
        }
        if known_values(graph).any(|name| name == to) {
            return Err(BundlingError::NameTaken { from: from.clone(), to: to.clone() });
        }
        rename_value(graph, from, to);
    }
    for (input, output) in &request.carry {
        for (name, role, infos) in [(input, "input", &graph.input), (output, "output", &graph.output)] {
            if !infos.iter().any(|info| info.name == *name) {
                return Err(unknown("--carry", name, role, infos.iter()));
            }
        }
        rename_value(graph, input, &format!("{CARRIED}{input}"));
        rename_value(graph, output, &format!("{CARRIED_NEXT}{input}"));
    }
    Ok(())
}

fn known_values(graph: &Graph) -> impl Iterator<Item = &String> {
    let border = graph.input.iter().chain(&graph.output).map(|info| &info.name);
    border.chain(graph.node.iter().flat_map(|node| &node.output))
}

fn unknown<'a>(
    option: &'static str,
    name: &str,
    role: &'static str,
    known: impl Iterator<Item = &'a ValueInfo>,
) -> BundlingError {
    let known = known.map(|info| info.name.as_str()).collect::<Vec<_>>().join(", ");
    BundlingError::Unknown { option, name: name.to_owned(), role, known }
}

fn rename_value(graph: &mut Graph, from: &str, to: &str) {
    let in_nodes = graph.node.iter_mut().flat_map(|node| node.input.iter_mut().chain(&mut node.output));
    let infos = graph.input.iter_mut().chain(&mut graph.output).chain(&mut graph.value_info);
    let names = in_nodes.chain(infos.map(|info| &mut info.name));
    names.filter(|name| *name == from).for_each(|name| to.clone_into(name));
}

/// Type and shape of inputs and outputs; a first dimension that is left open is the batch, which is 1. What the file says of values
/// in between may say otherwise, and is left out: it is worked out anew.
pub(super) fn border(graph: &mut Graph) -> Result<[Vec<TensorSpec>; 2], BundlingError> {
    graph.value_info.clear();
    let specs = |role: &'static str, infos: &mut [ValueInfo]| {
        infos.iter_mut().map(|info| spec(role, info)).collect::<Result<Vec<_>, _>>()
    };
    Ok([specs("input", &mut graph.input)?, specs("output", &mut graph.output)?])
}

fn spec(role: &'static str, info: &mut ValueInfo) -> Result<TensorSpec, BundlingError> {
    let tensor = info.r#type.as_mut().and_then(|kind| kind.tensor_type.as_mut());
    let first = tensor.and_then(|tensor| tensor.shape.as_mut()).and_then(|shape| shape.dim.first_mut());
    if let Some(batch) = first.filter(|dim| dim.dim_value.is_none()) {
        (batch.dim_value, batch.dim_param) = (Some(1), None);
    }
    let known = info.fixed().and_then(|(number, shape)| Some((DType::from_onnx(number)?, shape)));
    let (dtype, shape) = known.ok_or_else(|| BundlingError::NotFixed { role, name: info.name.clone() })?;
    Ok(TensorSpec { name: info.name.clone(), dtype, shape })
}

/// What of the robot the graph reads: as asked, or the cameras that it names, and all states where it reads any.
pub(super) fn policy_inputs(request: &Request, part: &PartEntry) -> Vec<String> {
    if let Some(inputs) = &request.inputs {
        return inputs.clone();
    }
    let (robot, reads) =
        (&request.interface, |name: &str| part.inputs.iter().any(|input| input.name == name));
    let only = robot.camera.len() == 1 && reads("image");
    let cameras = robot.camera.iter().filter(|camera| only || reads(&camera.name));
    let states = robot.state.iter().filter(|_| reads("state"));
    cameras.map(|camera| camera.name.clone()).chain(states.map(|state| state.name.clone())).collect()
}

/// The robot's cameras, and its states with their sizes.
pub(super) fn offers(robot: &Interface) -> String {
    let cameras = robot.camera.iter().map(|camera| format!("camera {} {:?}", camera.name, camera.shape));
    let states = robot.state.iter().map(|state| format!("{} of {}", state.name, state.elements.len()));
    let states = states.collect::<Vec<_>>().join(", ");
    let states = (!states.is_empty()).then(|| format!("state ({states})"));
    cameras.chain(states).collect::<Vec<_>>().join(", ")
}
