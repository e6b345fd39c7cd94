//! Golden values of a policy whose library is not here: what ONNX Runtime makes of made-up ticks.

use std::path::Path;

use ndarray::{ArrayD, IxDyn};
use rcwm_models::bundle::{Bundle, PolicyOutput, PolicySignature};
use rcwm_models::tensors::{Tensors, Values};
use rcwm_runtime::engine::{self, EngineKind, EngineSettings};
use rcwm_runtime::policy::{Graph, Inputs, PolicyError};

use super::BundlingError;

/// The tensors of the ticks so far, by name: shape of one tick, and the numbers.
#[derive(Default)]
struct Rows(Vec<(String, Vec<usize>, Vec<f32>)>);

impl Rows {
    fn push(&mut self, name: String, shape: &[usize], values: &[f32]) {
        match self.0.iter_mut().find(|(known, ..)| *known == name) {
            Some((_, _, all)) => all.extend_from_slice(values),
            None => self.0.push((name, shape.to_vec(), values.to_vec())),
        }
    }
}

/// Runs the policy for some ticks on moving gradients and swinging numbers, by ONNX Runtime; gives the values, and in words where
/// they come from. A second episode begins after two thirds.
pub(super) fn record(bundle: &Bundle, path: &Path, ticks: usize) -> Result<(Tensors, String), BundlingError> {
    let (manifest, ticks) = (&bundle.manifest, ticks.max(1));
    // Another engine than that which is deployed: what that one gets wrong would be right by itself.
    engine::available(EngineKind::Ort).map_err(BundlingError::NoGolden)?;
    let mut graph = Graph::load(bundle, EngineSettings::ort(1))?;
    let signature = PolicySignature::of(manifest, &manifest.parts[0]).map_err(PolicyError::from)?;
    let initial = &bundle.initial.branches[0].h;
    let (mut carried, mut rows, mut tensors) = (initial.clone(), Rows::default(), Tensors::default());
    let mut images: Vec<(String, Vec<usize>, Vec<u8>)> =
        manifest.cameras().map(|camera| (camera.name.clone(), camera.shape.to_vec(), Vec::new())).collect();
    let mut first = Vec::new();
    for tick in 0..ticks {
        let is_first = tick == 0 || ticks > 2 && tick == 2 * ticks / 3;
        if is_first {
            carried.clone_from(initial);
        }
        let action: Vec<f32> = (0..manifest.interface.action_numbers())
            .map(|axis| if is_first { 0.0 } else { swing(tick, axis) })
            .collect();
        let state: Vec<f32> = (0..manifest.measured_numbers()).map(|axis| swing(tick + 3, axis)).collect();
        let mut image = Vec::new();
        for (camera, (_, shape, all)) in images.iter_mut().enumerate() {
            let len: usize = shape.iter().product();
            let pixels: Vec<u8> = (0..len).map(|at| (at / 7 + 11 * tick + 50 * camera) as u8).collect();
            image.extend_from_slice(&pixels);
            all.extend_from_slice(&pixels);
        }
        graph.run(Inputs { image: &image, state: &state }, &action, &carried).map_err(PolicyError::from)?;
        for ((output, spec), found) in
            signature.outputs.iter().zip(&manifest.parts[0].outputs).zip(graph.outputs())
        {
            if found.iter().any(|x| !x.is_finite()) {
                let (path, name) = (path.to_path_buf(), spec.name.clone());
                return Err(BundlingError::NotFinite { path, name, tick });
            }
            rows.push(format!("expect/policy/{}", spec.name), &spec.shape, found);
            if let PolicyOutput::Carried(range) = output {
                carried[range.clone()].copy_from_slice(found);
            }
        }
        rows.push("input/action".into(), &[action.len()], &action);
        if !state.is_empty() {
            rows.push("input/state".into(), &[state.len()], &state);
        }
        first.push(u8::from(is_first));
    }
    let shaped = |shape: &[usize]| IxDyn(&[&[ticks], shape].concat());
    for (name, shape, values) in rows.0 {
        tensors.0.insert(name, Values::F32(array(shaped(&shape), values)));
    }
    for (name, shape, values) in images {
        tensors.0.insert(format!("input/{name}"), Values::U8(array(shaped(&shape), values)));
    }
    tensors.0.insert("input/is_first".into(), Values::U8(array(shaped(&[]), first)));
    Ok((tensors, format!("golden values: {ticks} made-up ticks, computed by ONNX Runtime")))
}

fn array<T>(shape: IxDyn, values: Vec<T>) -> ArrayD<T> {
    ArrayD::from_shape_vec(shape, values).expect("as many values as ticks times the shape of one")
}

/// Within -1 and 1, another for every axis.
fn swing(tick: usize, axis: usize) -> f32 {
    (0.3 * tick as f64 + 1.7 * axis as f64).sin() as f32
}
