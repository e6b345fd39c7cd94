//! A real bundle, changed copies of it, and a real peer on a link of its own.

#![allow(clippy::unwrap_used, reason = "a helper that fails fails its test")]

pub mod counting;
pub mod policies;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use prost::Message;
use rcwm_models::IMAGE_BYTES;
use rcwm_models::bundle::{Bundle, Limits, MANIFEST_FILE, Manifest, PartName};
use rcwm_models::files::sha256_hex;
use rcwm_models::interface::{ActionMode, Fallback as InterfaceFallback, FallbackRule};
use rcwm_models::onnx::{Graph, Model, Node, Tensor, data_type};
use rcwm_models::tensors::Values;
use rcwm_models::wire::clock::monotonic_ns;
use rcwm_models::wire::{
    Action, Format, LinkSettings, ObservationFlags, OwnedObservation, SimulatorLink, Wait, forget_prefix,
};
use rcwm_runtime::controller::{Controller, ControllerError, ControllerSettings, Ended, Fallback, RunReport};
use rcwm_runtime::log::{LogSettings, LogSummary, LogWriter};
use rcwm_runtime::record::{Finished, Recorder};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use serde_json::Value;

/// The smallest bundle that is shipped.
pub fn smallest_bundle() -> PathBuf {
    let bundles = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/bundles");
    let folders = std::fs::read_dir(&bundles).expect("models/bundles is part of the source");
    let folders = folders.map(|entry| entry.unwrap().path());
    let bytes = |folder: &PathBuf| -> u64 {
        let parts = Bundle::open(folder).unwrap().manifest.parts;
        parts.iter().map(|entry| entry.bytes).sum()
    };
    let smallest = folders.filter(|folder| folder.join(MANIFEST_FILE).is_file()).min_by_key(bytes);
    smallest.expect("at least one bundle is shipped in models/bundles")
}

/// A bundle of kind `dreamer` for the same robot: `rcwm-trainer init --model vanilla --preset debug --set deter=16 --set hidden=16
/// --set cnn_depth=2 --set units=16 --seed 5`, then `export --parts required --golden-ticks 4`.
pub fn dreamer_bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/dreamer")
}

/// A copy of the smallest bundle with a changed manifest.
pub fn with_manifest(change: impl FnOnce(&mut Manifest)) -> tempfile::TempDir {
    let copy = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(smallest_bundle()).unwrap() {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), copy.path().join(entry.file_name())).unwrap();
    }
    let path = copy.path().join(MANIFEST_FILE);
    let mut manifest: Manifest = toml::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    change(&mut manifest);
    std::fs::write(&path, toml::to_string(&manifest).unwrap()).unwrap();
    copy
}

/// A copy of the smallest bundle with one part's graph changed, with the right checksum.
fn with_graph(part: PartName, change: impl FnOnce(&mut Graph)) -> tempfile::TempDir {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let mut model = Model::decode(bundle.part(part).unwrap()).unwrap();
    change(model.graph.as_mut().unwrap());
    let bytes = model.encode_to_vec();
    let copy = with_manifest(|manifest| {
        let entry = manifest.parts.iter_mut().find(|entry| entry.name == part).unwrap();
        (entry.bytes, entry.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    });
    std::fs::write(copy.path().join(format!("{part}.onnx")), bytes).unwrap();
    copy
}

/// A bundle in which a weight of a part is NaN.
pub fn with_nan_weight(part: PartName) -> tempfile::TempDir {
    with_graph(part, |graph| {
        let is_matrix = |tensor: &&mut Tensor| tensor.data_type == data_type::FLOAT && tensor.dims.len() >= 2;
        let weight = graph.initializer.iter_mut().find(is_matrix).unwrap();
        weight.raw_data[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    })
}

/// A bundle whose weights are sound, but whose graph divides 0 by 0 on the way to a part's first output.
pub fn dividing_by_zero(part: PartName) -> tempfile::TempDir {
    with_graph(part, |graph| {
        let output = graph.output[0].name.clone();
        let clean = format!("{output}_clean");
        for node in &mut graph.node {
            let names = node.input.iter_mut().chain(&mut node.output);
            names.filter(|name| **name == output).for_each(|name| name.clone_from(&clean));
        }
        let node = |op: &str, a: &str, b: &str, to: &str| Node {
            op_type: op.into(),
            input: vec![a.into(), b.into()],
            output: vec![to.into()],
            name: format!("poison_{op}"),
            ..Node::default()
        };
        graph.node.push(node("Sub", &clean, &clean, "zero"));
        graph.node.push(node("Div", "zero", "zero", &output));
    })
}

/// A bundle with a layer whose weights are 2^30 times as small as they were, and whose result is made that much larger again, in two
/// steps: the same in 32 bits, nothing but zeros in 16.
pub fn too_small_for_16_bits(part: PartName) -> tempfile::TempDir {
    const STEP: f32 = (1 << 15) as f32;
    with_graph(part, |graph| {
        let layer = graph.node.iter().position(|node| node.op_type == "MatMul").unwrap();
        let (weight, output) = (graph.node[layer].input[1].clone(), graph.node[layer].output[0].clone());
        let tensor = graph.initializer.iter_mut().find(|tensor| tensor.name == weight).unwrap();
        for bytes in tensor.raw_data.as_chunks_mut::<4>().0 {
            *bytes = (f32::from_le_bytes(*bytes) / STEP / STEP).to_le_bytes();
        }
        let [small, larger] = ["small", "larger"].map(|what| format!("{output}_{what}"));
        graph.node[layer].output[0].clone_from(&small);
        graph.initializer.push(Tensor::f32("step", &[1], &[STEP]));
        for (place, from, to) in [(1, small, larger.clone()), (2, larger, output)] {
            let back = Node {
                op_type: "Mul".into(),
                input: vec![from, "step".into()],
                output: vec![to.clone()],
                name: format!("makes_{to}"),
                ..Node::default()
            };
            graph.node.insert(layer + place, back);
        }
    })
}

/// Long enough for a busy machine to read each answer before the next.
pub const PERIOD_NS: u64 = 200_000_000;
/// Far longer than anything here takes: reached only when an answer never comes.
pub const NEVER: Duration = Duration::from_secs(20);

/// An observation of a fixed clock, due now.
pub fn due_now(sequence: u64) -> OwnedObservation {
    let mut observation = observation(sequence, sequence as u32);
    (observation.scheduled_ns, observation.period_ns) = (monotonic_ns(), PERIOD_NS);
    observation
}

/// A link that no other test shares; nothing of it is left when this is dropped.
pub struct OwnLink(pub LinkSettings);

/// A link that no other test shares.
pub fn own_link() -> OwnLink {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let number = COUNT.fetch_add(1, Ordering::Relaxed);
    let prefix = Some(format!("rt{}_{number}_", std::process::id()));
    OwnLink(LinkSettings { prefix, ..LinkSettings::new("test") })
}

impl OwnLink {
    /// Connects a peer that plays the simulator.
    pub fn peer(&self) -> SimulatorLink {
        SimulatorLink::open(self.0.clone(), &Format::metaworld()).unwrap()
    }

    /// The same, of a robot that fits a bundle.
    pub fn peer_of(&self, bundle: &Path) -> SimulatorLink {
        let manifest = Bundle::open(bundle).unwrap().manifest;
        SimulatorLink::open(self.0.clone(), &Format::of(manifest.interface)).unwrap()
    }

    pub fn prefix(&self) -> &str {
        self.0.prefix.as_deref().unwrap()
    }
}

impl Drop for OwnLink {
    fn drop(&mut self) {
        forget_prefix(self.prefix());
    }
}

/// Starts a controller of a bundle; it ends when the peer closes, and gives its report.
pub fn start_controller(bundle: &Path, link: &OwnLink, fallback: Fallback) -> JoinHandle<RunReport> {
    start(bundle, link, fallback, |controller| {
        let ended = controller.run(&AtomicBool::new(false), &mut []).unwrap();
        controller.report(EngineKind::Tract, ended)
    })
}

/// The same with settings of its own; gives how it ended as well.
pub fn start_controller_with(
    bundle: &Path,
    link: &OwnLink,
    change: impl FnOnce(&mut ControllerSettings),
) -> JoinHandle<(Result<Ended, ControllerError>, RunReport)> {
    let policy = Policy::load(bundle, EngineSettings::tract()).unwrap();
    let mut settings =
        ControllerSettings { first_timeout: Some(NEVER), ..ControllerSettings::new(link.0.clone()) };
    change(&mut settings);
    std::thread::spawn(move || {
        let mut controller = Controller::open(policy, settings).unwrap();
        let ended = controller.run(&AtomicBool::new(false), &mut []);
        let report =
            controller.report(EngineKind::Tract, ended.as_ref().map_or_else(Ended::from, |ended| *ended));
        (ended, report)
    })
}

/// The same with a log; gives what was written.
pub fn start_logging(
    policy: Policy,
    link: &OwnLink,
    file: &Path,
    settings: LogSettings,
    records: usize,
    change: impl FnOnce(&mut ControllerSettings),
) -> JoinHandle<LogSummary> {
    let log = LogWriter::start(file, &policy, settings).unwrap();
    let mut recorder = Recorder::with_records(&policy, log, records).unwrap();
    start_changed(policy, link, change, move |controller| {
        controller.run(&AtomicBool::new(false), &mut [&mut recorder]).unwrap();
        let Finished { sink, dropped } = recorder.finish().unwrap();
        sink.finish(dropped).unwrap()
    })
}

fn start<T: Send + 'static>(
    bundle: &Path,
    link: &OwnLink,
    fallback: Fallback,
    run: impl FnOnce(&mut Controller) -> T + Send + 'static,
) -> JoinHandle<T> {
    start_with(Policy::load(bundle, EngineSettings::tract()).unwrap(), link, fallback, run)
}

/// Starts a controller of a policy in another thread.
pub fn start_with<T: Send + 'static>(
    policy: Policy,
    link: &OwnLink,
    fallback: Fallback,
    run: impl FnOnce(&mut Controller) -> T + Send + 'static,
) -> JoinHandle<T> {
    start_changed(policy, link, |settings| settings.fallback = fallback, run)
}

/// The same with changed settings.
pub fn start_changed<T: Send + 'static>(
    policy: Policy,
    link: &OwnLink,
    change: impl FnOnce(&mut ControllerSettings),
    run: impl FnOnce(&mut Controller) -> T + Send + 'static,
) -> JoinHandle<T> {
    let mut settings =
        ControllerSettings { first_timeout: Some(NEVER), ..ControllerSettings::new(link.0.clone()) };
    change(&mut settings);
    std::thread::spawn(move || run(&mut Controller::open(policy, settings).unwrap()))
}

/// A copy of the smallest bundle with the golden mean actions changed, with the right checksum.
pub fn with_golden(change: impl Fn(f32) -> f32) -> tempfile::TempDir {
    let mut golden = Bundle::open(&smallest_bundle()).unwrap().golden;
    let Some(Values::F32(mean)) = golden.0.get_mut("expect/actor/mean") else { panic!("no golden mean") };
    mean.mapv_inplace(change);
    let bytes = golden.to_bytes().unwrap();
    let copy = with_manifest(|manifest| {
        (manifest.golden.bytes, manifest.golden.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    });
    std::fs::write(copy.path().join("golden.safetensors"), bytes).unwrap();
    copy
}

/// Narrower limits for a policy's actions.
pub fn limit(manifest: &mut Manifest, low: [f32; 4], high: [f32; 4]) {
    manifest.policy.limits = Some(Limits { low: low.into(), high: high.into() });
}

/// What a policy's actions command.
pub fn set_mode(manifest: &mut Manifest, mode: ActionMode) {
    let action = &mut manifest.interface.action[0];
    action.mode = mode;
    action.fallback = InterfaceFallback::Rule(match mode {
        ActionMode::Absolute => FallbackRule::Hold,
        ActionMode::Delta | ActionMode::Velocity => FallbackRule::Zero,
    });
}

/// An observation of an episode that begins at step 0, with an image of its own.
pub fn observation(sequence: u64, step: u32) -> OwnedObservation {
    let mut observation = OwnedObservation::zeroed(&Format::metaworld());
    (observation.sequence, observation.step) = (sequence, step);
    observation.flags = ObservationFlags::default().with(ObservationFlags::FIRST, step == 0).0;
    if step > 0 {
        observation.edit().executed().copy_from_slice(&[0.3, -0.2, 0.1, 1.0]);
    }
    observation.edit().image(0).copy_from_slice(&image(step));
    observation
}

/// A picture that differs from step to step.
pub fn image(step: u32) -> [u8; IMAGE_BYTES] {
    std::array::from_fn(|i| {
        ((i as u32).wrapping_mul(2_654_435_761).wrapping_add(step.wrapping_mul(977)) >> 13) as u8
    })
}

/// Waits until a controller has found the robot: what is published from here on reaches it.
pub fn meet(peer: &SimulatorLink) {
    let start = std::time::Instant::now();
    while !peer.wait_action(Duration::from_millis(20)).unwrap().1.hello {
        assert!(start.elapsed() < NEVER, "no controller came");
    }
}

/// Publishes an observation and waits for the action that answers it.
pub fn ask(peer: &SimulatorLink, observation: &OwnedObservation) -> Action {
    peer.publish_copy(observation).unwrap();
    let start = std::time::Instant::now();
    while start.elapsed() < NEVER {
        match peer.wait_action(Duration::from_millis(100)).unwrap() {
            (Wait::Message(action), _) if action.answers == observation.sequence => return action,
            // The controller has just connected, or has lost the message to its start: ask again.
            (Wait::TimedOut, events) if events.hello => peer.publish_copy(observation).unwrap(),
            _ => {}
        }
    }
    panic!("observation {} was not answered", observation.sequence);
}

/// A file of JSON lines.
pub fn json_lines(file: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(file).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// What a summary of latencies says of a stage.
pub fn latency_of<'a>(summary: &'a Value, name: &str) -> &'a Value {
    let stages = summary["latency"].as_array().unwrap();
    stages.iter().find(|latency| latency["stage"] == name).unwrap_or(&Value::Null)
}
