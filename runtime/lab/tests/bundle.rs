//! Bundles of kind `recurrent`: made of ONNX files of any library, run, verified, logged and replayed.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use rcwm_lab::bundle::{BundlingError, Request, build};
use rcwm_lab::log::Replayer;
use rcwm_models::bundle::{Bundle, BundleKind, WriteError};
use rcwm_models::interface::Interface;
use rcwm_models::onnx::{Graph, ValueInfo, data_type};
use rcwm_models::tensors::{Tensors, Values};
use rcwm_models::wire::{Action, ActionSource, ActionValues, OwnedObservation, SimulatorLink, Wait};
use rcwm_runtime::controller::{Controller, ControllerError, ControllerSettings, Fallback};
use rcwm_runtime::engine::{EngineKind, available};
use rcwm_runtime::log::{LogReader, LogSettings};
use rcwm_runtime::policy::{Inputs, Sampling, SurpriseLimits};
use rcwm_runtime::verify::verify;
use rcwm_runtime::{EngineSettings, Policy, PolicyError};
use rcwm_testkit::{NEVER, due_now, image, own_link, policies, start_logging};

fn request(onnx: PathBuf) -> Request {
    Request {
        onnx,
        interface: Interface::metaworld(),
        inputs: None,
        rename: Vec::new(),
        carry: Vec::new(),
        initial: None,
        golden: None,
        golden_ticks: 12,
        task: "own".into(),
        replace: false,
    }
}

/// A bundle of a graph, or why there is none.
fn bundled(folder: &Path, graph: Graph, change: impl FnOnce(&mut Request)) -> Result<Bundle, BundlingError> {
    let onnx = folder.join("policy.onnx");
    policies::write(graph, &onnx);
    let mut request = request(onnx);
    change(&mut request);
    build(&request, &folder.join("bundle"))
}

fn engines() -> Vec<EngineSettings> {
    let mut engines = vec![EngineSettings::tract()];
    engines.extend(available(EngineKind::Ort).is_ok().then(|| EngineSettings::ort(1)));
    engines
}

const STATE: [f32; 18] = [0.25; 18];

fn seen(image: &[u8]) -> Inputs<'_> {
    Inputs { image, state: &STATE }
}

#[test]
fn a_policy_with_and_one_without_carried_state_are_verified_on_every_engine() {
    for (graph, carried) in [(policies::mlp(), 0), (policies::lstm(), 2 * policies::HIDDEN)] {
        let folder = tempfile::tempdir().unwrap();
        let bundle = bundled(folder.path(), graph, |_| {}).unwrap();
        assert_eq!(
            (bundle.manifest.kind, bundle.initial.branches[0].h.len()),
            (BundleKind::Recurrent, carried)
        );
        assert!(bundle.manifest.provenance.data.contains("policy.onnx, sha256 "));
        for engine in engines() {
            let report = verify(&bundle, engine, 1e-5, &mut || {}).unwrap();
            assert!(report.failures.is_empty(), "{:?}", report.failures);
            assert_eq!((report.recurrent.ticks_compared, report.recurrent.std_error_max), (12, None));
        }
    }
}

#[test]
fn what_is_carried_starts_anew_with_an_episode_and_follows_what_was_executed() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = bundled(folder.path(), policies::lstm(), |_| {}).unwrap();
    for engine in engines() {
        let mut policy = Policy::new(&bundle, engine, Sampling::Mode).unwrap();
        let (picture, executed) = (image(0), ActionValues::from([0.4; 4]));
        let first = policy.observe(seen(&picture), None).unwrap();
        let carried = policy.state().clone();
        policy.warm_caches();
        assert_eq!(*policy.state(), carried);
        assert_eq!((first.surprise, first.std), (None, ActionValues::zeros(4)));
        assert!(first.action.iter().all(|x| (-1.0..=1.0).contains(x)));
        let second = policy.observe(seen(&picture), Some(&executed)).unwrap();
        assert_ne!(first.action, second.action);
        let (state, other) = (policy.state().clone(), ActionValues::from([-0.4; 4]));
        policy.observe(seen(&picture), None).unwrap();
        let elsewhere = policy.observe(seen(&picture), Some(&other)).unwrap();
        assert_ne!(elsewhere.action, second.action);
        assert_ne!(*policy.state(), state);
        assert_eq!(policy.observe(seen(&picture), None).unwrap().action, first.action);
    }
}

#[test]
fn where_nothing_came_the_last_action_is_held_and_the_state_stays() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = bundled(folder.path(), policies::lstm(), |_| {}).unwrap();
    let mut policy = Policy::new(&bundle, EngineSettings::tract(), Sampling::Mode).unwrap();
    policy.observe(seen(&image(0)), None).unwrap();
    let (state, executed) = (policy.state().clone(), ActionValues::from([0.1, -0.2, 0.3, 0.4]));
    let held = policy.imagine(&executed).unwrap();
    assert_eq!((held.action, held.surprise, policy.imagines()), (executed, None, false));
    assert_eq!(*policy.state(), state);
    let beyond = policy.imagine(&[7.0; 4].into()).unwrap();
    assert_eq!(beyond.action, [1.0; 4]);
}

#[test]
fn what_the_kind_does_not_have_is_refused_by_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = bundled(folder.path(), policies::mlp(), |_| {}).unwrap();
    let load = |engine, sampling| Policy::new(&bundle, engine, sampling);
    let sampled = load(EngineSettings::tract(), Sampling::Sample { seed: 1 });
    assert!(matches!(sampled, Err(PolicyError::NothingToSample)));
    let half = load(EngineSettings::tract().with_half_weights(true), Sampling::Mode).err().unwrap();
    assert!(half.to_string().contains("--half-weights"), "{half}");
    let link = own_link();
    let surprise = SurpriseLimits { robot_max: Some(1.0), ..SurpriseLimits::default() };
    let settings = ControllerSettings { surprise, ..ControllerSettings::new(link.0.clone()) };
    let policy = load(EngineSettings::tract(), Sampling::Mode).unwrap();
    let refused = Controller::open(policy, settings).err().unwrap();
    assert!(matches!(refused, ControllerError::NoSuchSurprise(_)));
    assert!(refused.to_string().contains("--surprise-robot-max"), "{refused}");
}

#[test]
fn a_run_that_misses_frames_holds_then_falls_back_and_is_replayed_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = bundled(folder.path(), policies::lstm(), |_| {}).unwrap();
    let (engine, link, file) = (EngineSettings::tract(), own_link(), folder.path().join("run.rcwmlog"));
    let peer = link.peer();
    let policy = Policy::new(&bundle, engine, Sampling::Mode).unwrap();
    let fallback = Fallback::Zero;
    let log = LogSettings { fallback, ..LogSettings::new("test", engine, Sampling::Mode) };
    let controller = start_logging(policy, &link, &file, log, 512, |settings| {
        settings.fallback = fallback;
        settings.ticks.imagined_ticks_max = 2;
    });
    let due = |sequence: u64| {
        let mut due = due_now(sequence);
        due.edit().executed().fill(0.3);
        due
    };
    ask_now(&peer, || due(0));
    let held = ask_now(&peer, || due(1)).action;
    // Silence: held twice, then the fallback.
    let mut found = Vec::new();
    while found.len() < 3 {
        if let (Wait::Message(action), _) = peer.wait_action(NEVER).unwrap()
            && action.answers > 1
        {
            found.push((action.source, action.action));
        }
    }
    let source = ActionSource::Fallback as u32;
    assert_eq!(found, [(source, held), (source, held), (source, ActionValues::zeros(4))]);
    ask_now(&peer, || due(10));
    peer.close().unwrap();
    controller.join().unwrap();
    let mut reader = LogReader::open(&file).unwrap();
    let place = folder.path().join("bundle");
    let mut replayer = Replayer::new(reader.header(), &[place], None).unwrap();
    let report = replayer.run(&mut reader, &mut |_| true).unwrap();
    assert_eq!((report.first_difference, report.answers.imagined), (None, 0));
    assert!(report.ticks_compared >= 6, "{}", report.ticks_compared);
}

/// Publishes until it is answered: whoever has connected just now may not hear the first.
fn ask_now(peer: &SimulatorLink, observation: impl Fn() -> OwnedObservation) -> Action {
    loop {
        let sent = observation();
        peer.publish_copy(&sent).unwrap();
        if let (Wait::Message(action), _) = peer.wait_action(Duration::from_millis(500)).unwrap()
            && action.answers == sent.sequence
        {
            return action;
        }
    }
}

fn changed(change: impl FnOnce(&mut Graph)) -> Graph {
    let mut graph = policies::lstm();
    change(&mut graph);
    graph
}

fn float(name: &str, shape: &[usize]) -> ValueInfo {
    ValueInfo::tensor(name, data_type::FLOAT, shape)
}

#[test]
fn a_graph_that_does_not_fit_is_refused_with_what_was_found_and_what_is_expected() {
    let cases: [(Graph, &[&str]); 6] = [
        (changed(|graph| graph.input[1] = float("state", &[1, 17])), &["state", "[1, 17]", "f32 [1, 18]"]),
        (changed(|graph| graph.input[0].name = "front".into()), &["front", "one of", "executed_action"]),
        (changed(|graph| graph.output[0] = float("action", &[1, 5])), &["action", "[1, 5]", "f32 [1, 4]"]),
        (changed(|graph| graph.output.truncate(2)), &["no output", "next_state.c"]),
        (changed(|graph| graph.output[1].name = "h".into()), &["\"h\"", "next_state.h"]),
        (changed(|graph| graph.node[9].op_type = "Det".into()), &["Det"]),
    ];
    for (graph, words) in cases {
        let folder = tempfile::tempdir().unwrap();
        let said = bundled(folder.path(), graph, |_| {}).unwrap_err().to_string();
        assert!(words.iter().all(|word| said.contains(word)) && !said.contains('\n'), "{words:?}: {said}");
        assert!(!folder.path().join("bundle").exists());
    }
    let folder = tempfile::tempdir().unwrap();
    let rename = |request: &mut Request| request.rename = vec![("obs".into(), "state".into())];
    let said = bundled(folder.path(), policies::mlp(), rename).unwrap_err().to_string();
    assert!(said.contains("--rename obs") && said.contains("state, action"), "{said}");
    let inputs = |request: &mut Request| request.inputs = Some(vec!["finger_vel".into()]);
    let said = bundled(folder.path(), policies::mlp(), inputs).unwrap_err().to_string();
    assert!(said.contains("[1, 18]") && said.contains("f32 [1, 2]"), "{said}");
}

#[test]
fn a_bundle_is_replaced_only_when_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    bundled(folder.path(), policies::mlp(), |_| {}).unwrap();
    let again = bundled(folder.path(), policies::lstm(), |_| {});
    assert!(matches!(again, Err(BundlingError::Write(WriteError::Exists { .. }))));
    let bundle = bundled(folder.path(), policies::lstm(), |request| request.replace = true).unwrap();
    assert_eq!(bundle.manifest.parts[0].inputs.len(), 5);
}

/// Made by the `onnx` package, with a batch that is left open and names of its own; its golden values are the package's reference
/// implementation's, which is written in Python.
#[test]
fn an_lstm_of_another_library_becomes_a_bundle_that_gives_that_librarys_numbers() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let pair = |from: &str, to: &str| (from.to_owned(), to.to_owned());
    for picture in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let mut make = Command::new(root.join(".venv/bin/python"));
        make.arg(root.join("tests/python/make_policy.py")).arg(folder.path());
        assert!(make.args(picture.then_some("--picture")).status().unwrap().success());
        let mut rename = vec![pair("obs", "state"), pair("actions", "action")];
        rename.extend(picture.then(|| pair("camera", "image")));
        let request = Request {
            rename,
            carry: vec![pair("h_in", "h_out"), pair("c_in", "c_out")],
            golden: Some(folder.path().join("golden.safetensors")),
            ..request(folder.path().join("lstm.onnx"))
        };
        let bundle = build(&request, &folder.path().join("bundle")).unwrap();
        let states = ["joint_pos", "arm_vel", "finger_vel"];
        assert_eq!(
            bundle.manifest.policy.inputs,
            [if picture { &["image"][..] } else { &[] }, &states].concat()
        );
        for engine in engines() {
            let report = verify(&bundle, engine, 1e-5, &mut || {}).unwrap();
            assert!(report.failures.is_empty(), "{:?}", report.failures);
        }
    }
}

#[test]
fn a_number_that_is_none_is_found_inside_the_graph_though_what_follows_hides_it() {
    for (operator, measured) in [("Sqrt", 2.0), ("Reciprocal", 1.5), ("Log", 1.5)] {
        let folder = tempfile::tempdir().unwrap();
        bundled(folder.path(), policies::diverging(1.5, operator), |_| {}).unwrap();
        let mut policy = Policy::load(&folder.path().join("bundle"), EngineSettings::tract()).unwrap();
        policy.observe(seen(&[]), None).unwrap();
        let state = [measured; 18];
        let error = policy.observe(Inputs { image: &[], state: &state }, None).unwrap_err();
        assert!(
            matches!(error, PolicyError::NotFinite { output: "a value inside", .. }),
            "{operator}: {error}"
        );
        policy.observe(seen(&[]), None).unwrap();
    }
}

#[test]
fn a_cell_keeps_nothing_that_is_not_carried_by_the_runtime() {
    let folder = tempfile::tempdir().unwrap();
    // A second episode begins within the golden ticks.
    let bundle = bundled(folder.path(), policies::gru(), |_| {}).unwrap();
    for engine in engines() {
        assert!(verify(&bundle, engine, 1e-5, &mut || {}).unwrap().failures.is_empty());
    }
    let mut policy = Policy::load(&folder.path().join("bundle"), EngineSettings::tract()).unwrap();
    let first = policy.observe(seen(&[]), None).unwrap().action;
    policy.observe(seen(&[]), Some(&first)).unwrap();
    policy.warm_caches();
    assert_eq!(policy.observe(seen(&[]), None).unwrap().action.to_bits(), first.to_bits());
}

#[test]
fn actions_that_are_no_shares_of_the_limits_are_refused() {
    let mut graph = policies::mlp();
    graph.node.pop();
    graph.node[2].output[0] = "action".into();
    let folder = tempfile::tempdir().unwrap();
    let said = bundled(folder.path(), graph, |_| {}).unwrap_err().to_string();
    assert!(said.contains("the action reaches") && said.contains("-1 to 1"), "{said}");
}

#[test]
fn names_that_are_taken_and_states_that_nothing_carries_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let rename = |request: &mut Request| request.rename = vec![("state".into(), "action".into())];
    let said = bundled(folder.path(), policies::mlp(), rename).unwrap_err().to_string();
    assert!(said.contains("--rename state=action"), "{said}");
    let other = folder.path().join("other.safetensors");
    let golden = Tensors(std::iter::once(("state.x".to_owned(), values(&[1.0]))).collect());
    std::fs::write(&other, golden.to_bytes().unwrap()).unwrap();
    let initial = |request: &mut Request| request.initial = Some(other.clone());
    let said = bundled(folder.path(), policies::mlp(), initial).unwrap_err().to_string();
    assert!(said.contains("state.x") && said.contains("no state is carried"), "{said}");
    let twice = |request: &mut Request| request.inputs = Some(vec!["joint_pos".into(), "joint_pos".into()]);
    let said = bundled(folder.path(), policies::mlp(), twice).unwrap_err().to_string();
    assert!(said.contains("joint_pos") && said.contains("twice"), "{said}");
}

fn values(numbers: &[f32]) -> Values {
    Values::F32(ndarray::ArrayD::from_shape_vec(vec![numbers.len()], numbers.to_vec()).unwrap())
}
