//! A bundle that passes every check at loading and still gives NaN, now and then.

use prost::Message;
use rcwm_models::bundle::{Bundle, MANIFEST_FILE, Manifest, PartName};
use rcwm_models::files::sha256_hex;
use rcwm_models::onnx::{Model, Node, Tensor};
use rcwm_models::wire::ActionValues;
use rcwm_runtime::{EngineSettings, Policy};

use crate::shipped_bundle;

/// A copy of the shipped bundle whose actor gives NaN for about half of all images.
///
/// Weights that are no numbers are refused at loading, so the graph is grafted: with `a = relu(mean - c)` the mean is multiplied by
/// `a / a`, which is 1, or NaN where the first component is at most its median c.
///
/// # Panics
/// When files cannot be written.
#[must_use]
pub fn poisoned_bundle() -> tempfile::TempDir {
    let source = Bundle::open(&shipped_bundle()).expect("the shipped bundle is sound");
    let copy = tempfile::tempdir().expect("a temporary folder");
    for entry in std::fs::read_dir(shipped_bundle()).expect("it is there") {
        let entry = entry.expect("it can be read");
        std::fs::copy(entry.path(), copy.path().join(entry.file_name())).expect("it can be copied");
    }
    let bytes = graft(source.part(PartName::Actor).expect("a required part"), median_of_mean());
    let mut manifest: Manifest = source.manifest;
    let entry = manifest.parts.iter_mut().find(|entry| entry.name == PartName::Actor);
    let entry = entry.expect("a required part");
    let path = copy.path().join(&entry.file);
    (entry.bytes, entry.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    let text = toml::to_string(&manifest).expect("a manifest is TOML");
    std::fs::write(path, bytes).expect("it can be written");
    std::fs::write(copy.path().join(MANIFEST_FILE), text).expect("it can be written");
    copy
}

fn graft(part: &[u8], threshold: f32) -> Vec<u8> {
    let mut model = Model::decode(part).expect("the shipped bundle is sound");
    let graph = model.graph.as_mut().expect("a model has a graph");
    for node in &mut graph.node {
        let names = node.input.iter_mut().chain(&mut node.output);
        names.filter(|name| *name == "mean").for_each(|name| "clean_mean".clone_into(name));
    }
    // No mean is at most -2: the other components never break.
    graph.initializer.push(Tensor::f32("threshold", &[1, 4], &[threshold, -2.0, -2.0, -2.0]));
    let mut add = |op: &str, inputs: &[&str], output: &str| {
        graph.node.push(Node {
            op_type: op.into(),
            input: inputs.iter().map(|name| (*name).to_owned()).collect(),
            output: vec![output.into()],
            name: format!("poison_{op}"),
            ..Node::default()
        });
    };
    add("Sub", &["clean_mean", "threshold"], "above");
    add("Relu", &["above"], "positive");
    add("Div", &["positive", "positive"], "one_or_nan");
    add("Mul", &["clean_mean", "one_or_nan"], "mean");
    model.encode_to_vec()
}

/// The median of the mean action's first component over the recorded images.
fn median_of_mean() -> f32 {
    let mut policy = Policy::load(&shipped_bundle(), EngineSettings::tract()).expect("it loads");
    let mut means: Vec<f32> = super::peer::recorded_images()
        .iter()
        .enumerate()
        .map(|(index, image)| {
            policy.observe(image, (index > 0).then_some(&ActionValues::zeros(4))).expect("it runs").mean[0]
        })
        .collect();
    means.sort_by(f32::total_cmp);
    means[means.len() / 2]
}
