//! Bundles: written whole, opened as a runtime opens them.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use assert_cmd::Command;
use ndarray::{Array2, Array4};
use rcwm_models::bundle::{Bundle, BundleKind, MANIFEST_FILE, PartName, WriteError};
use rcwm_models::episode::Episode;
use rcwm_models::interface::Interface;
use rcwm_models::onnx;
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_models::tensors::Values;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::export::{self, ExportError, Options, Progress};

struct Patient;

impl Progress for Patient {
    fn step(&self, _: &str, _: usize, _: usize) -> Result<(), ExportError> {
        Ok(())
    }
}

/// Stops the export at a certain step.
struct StopsAt(AtomicUsize);

impl Progress for StopsAt {
    fn step(&self, _: &str, _: usize, _: usize) -> Result<(), ExportError> {
        match self.0.fetch_sub(1, Ordering::Relaxed) {
            0 => Err(ExportError::Interrupted),
            _ => Ok(()),
        }
    }
}

fn options() -> Options {
    Options {
        task: "reach".into(),
        interface: Interface::metaworld(),
        parts: BundleKind::Rcwm.all_parts().collect(),
        golden_episode: None,
        golden_ticks: 6,
        golden_seed: 1,
        source_revision: "test".into(),
        replace: false,
    }
}

fn export(checkpoint: &Checkpoint, place: &Path, options: &Options) -> Result<Bundle, ExportError> {
    export::write(checkpoint, place, options, &Patient)
}

fn entries(folder: &Path) -> usize {
    fs::read_dir(folder).unwrap().count()
}

#[test]
fn a_bundle_opens_with_every_part_golden_values_and_the_initial_state() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("bundle");
    export(&support::reference_checkpoint(), &place, &options()).unwrap();
    let bundle = Bundle::open(&place).unwrap();
    assert_eq!(bundle.parts.len(), 8);
    assert_eq!((bundle.manifest.task.as_str(), bundle.manifest.provenance.updates), ("reach", 0));
    assert!(bundle.initial.branches[0].h.iter().any(|x| *x != 0.0));
    let model = bundle.manifest.model.as_ref().unwrap();
    for name in BundleKind::Rcwm.all_parts() {
        for output in name.signature(model).1 {
            let golden = bundle.golden.get(&format!("expect/{name}/{}", output.name)).unwrap();
            assert_eq!(golden.shape()[1..], output.shape[1..], "{name}/{}", output.name);
        }
    }
    let noise = bundle.golden.f32("input/robot_noise").unwrap();
    assert_eq!(noise.shape(), [6, 2, model.categoricals, model.classes]);
    assert!(noise.iter().any(|x| *x != 0.0));
    let first = bundle.golden.u8("input/is_first").unwrap();
    assert_eq!(first.iter().copied().collect::<Vec<_>>(), [1, 0, 0, 0, 1, 0]);
}

#[test]
fn the_required_parts_alone_are_a_bundle_without_the_others_golden_values() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("bundle");
    let options = Options { parts: BundleKind::Rcwm.parts().to_vec(), ..options() };
    let bundle = export(&support::reference_checkpoint(), &place, &options).unwrap();
    assert_eq!(bundle.parts.len(), 5);
    assert!(bundle.golden.0.keys().all(|name| !name.contains("decoder") && !name.contains("reward")));
}

#[test]
fn graphs_have_known_shapes_everywhere_and_no_constant_twice() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = export(&support::reference_checkpoint(), &folder.path().join("bundle"), &options()).unwrap();
    for (name, bytes) in &bundle.parts {
        let graph = onnx::parse_self_contained(bytes).unwrap().graph.unwrap();
        let known = |value: &String| {
            graph
                .value_info
                .iter()
                .chain(&graph.output)
                .any(|info| info.name == *value && info.fixed().is_some())
        };
        assert!(graph.node.iter().flat_map(|node| &node.output).all(known), "{name}");
        let mut constants: Vec<_> = graph.initializer.iter().map(|tensor| &tensor.name).collect();
        constants.sort();
        assert!(constants.windows(2).all(|pair| pair[0] != pair[1]), "{name}");
        let used = |constant: &&String| graph.node.iter().any(|node| node.input.contains(constant));
        assert!(constants.iter().all(used), "{name} carries a weight that nothing uses");
    }
}

#[test]
fn the_same_checkpoint_gives_the_same_bundle() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = support::reference_checkpoint();
    let one = export(&checkpoint, &folder.path().join("one"), &options()).unwrap();
    let two = export(&checkpoint, &folder.path().join("two"), &options()).unwrap();
    assert_eq!(one.manifest, two.manifest);
}

#[test]
fn a_bundle_is_replaced_only_on_demand_and_a_folder_that_is_none_never() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("bundle");
    let checkpoint = support::untrained(ModelKind::Rcwm, 1);
    let old = export(&checkpoint, &place, &options()).unwrap();
    assert!(matches!(
        export(&checkpoint, &place, &options()),
        Err(ExportError::Write(WriteError::Exists { .. }))
    ));
    let replacing = Options { replace: true, ..options() };
    let new = export(&support::untrained(ModelKind::Rcwm, 2), &place, &replacing).unwrap();
    assert_ne!(old.manifest.parts, new.manifest.parts);
    assert_eq!(entries(folder.path()), 1);

    let other = folder.path().join("notes");
    fs::create_dir(&other).unwrap();
    fs::write(other.join("notes.txt"), "keep").unwrap();
    assert!(matches!(
        export(&checkpoint, &other, &replacing),
        Err(ExportError::Write(WriteError::NotABundle { .. }))
    ));
    assert!(other.join("notes.txt").exists());
}

#[test]
fn an_interrupted_export_leaves_the_old_bundle_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("bundle");
    let checkpoint = support::untrained(ModelKind::Rcwm, 1);
    let old = export(&checkpoint, &place, &options()).unwrap();
    let replacing = Options { replace: true, ..options() };
    for step in [0, 3, 10, 14] {
        let stops = StopsAt(AtomicUsize::new(step));
        let result = export::write(&support::untrained(ModelKind::Rcwm, 2), &place, &replacing, &stops);
        assert!(matches!(result, Err(ExportError::Interrupted)), "step {step}");
        assert_eq!(Bundle::open(&place).unwrap().manifest, old.manifest);
        assert_eq!(entries(folder.path()), 1);
    }
}

/// Seven joints, two cameras of 128 x 128.
fn two_cameras() -> Interface {
    Interface::parse(include_str!("data/two-cameras.toml")).unwrap()
}

/// ONNX Runtime and the official checker, which share no code with this project, on every part and on the recurrent policy.
fn check_with_python(bundle: &Path) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut check = Command::new(root.join(".venv/bin/python"));
    check.arg(root.join("tests/python/check_bundle.py")).arg(bundle);
    let said = check.assert().success();
    let said = String::from_utf8_lossy(&said.get_output().stdout).into_owned();
    assert!(said.contains("all parts within 1e-05 over 6 ticks"), "{said}");
}

#[test]
fn exported_graphs_of_two_large_cameras_and_a_measured_state_give_the_models_numbers() {
    for (kind, acting, mask) in
        [(ModelKind::Rcwm, PartName::Robot, "robot_mask"), (ModelKind::Vanilla, PartName::Dynamics, "mask")]
    {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("bundle");
        let debug = ModelSettings::preset(Preset::Debug, kind);
        let model = ModelSettings { action: 7, image_side: 128, cameras: 2, state: 14, ..debug };
        let checkpoint = support::checkpoint(support::lively_parameters(&model), model.clone());
        let parts = BundleKind::of(kind).all_parts().collect();
        let options = Options { interface: two_cameras(), parts, ..options() };
        let bundle = export(&checkpoint, &place, &options).unwrap();
        let shape = |input: &str| bundle.golden.get(input).unwrap().shape().to_vec();
        assert_eq!(shape("input/image"), [6, 128, 128, 6]);
        assert_eq!((shape("input/action"), shape("input/state")), (vec![6, 7], vec![6, 14]));
        assert_eq!(shape(&format!("expect/decoder/{mask}"))[1..], [128, 128, 2]);
        let (inputs, _) = acting.signature(&model);
        assert_eq!((inputs[5].name.as_str(), inputs[5].shape.as_slice()), ("state", &[1, 14][..]));
        assert_eq!(bundle.manifest.policy.inputs, ["front", "wrist", "joint_pos", "joint_vel"]);
        check_with_python(&place);
    }
}

#[test]
fn a_vanilla_model_becomes_a_bundle_of_one_branch() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("bundle");
    let vanilla = support::untrained(ModelKind::Vanilla, 1);
    // The parts of two branches are another kind's.
    let error = export(&vanilla, &place, &options()).unwrap_err().to_string();
    assert!(error.contains("part robot is not one of kind dreamer"), "{error}");
    assert_eq!(entries(folder.path()), 0);
    let options = Options { parts: BundleKind::Dreamer.all_parts().collect(), ..options() };
    let bundle = export(&vanilla, &place, &options).unwrap();
    assert_eq!(bundle.manifest.kind, BundleKind::Dreamer);
    let names: Vec<&str> = bundle.manifest.parts.iter().map(|part| part.name.as_str()).collect();
    assert_eq!(names, ["encoder", "dynamics", "actor", "reward", "continue", "decoder"]);
    assert_eq!(bundle.initial.branches.len(), 1);
}

#[test]
fn golden_values_can_come_from_a_recorded_episode() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("episode.npz");
    let episode = Episode {
        image: Array4::from_shape_fn((4, 64, 64, 3), |(t, y, x, c)| (t * 40 + y + x + c) as u8),
        action: Array2::from_shape_fn((4, 4), |(t, _)| if t == 0 { 0.0 } else { 0.5 }),
        ..Episode::blank(4)
    };
    episode.write(&file).unwrap();
    let options = Options { golden_episode: Some(file), golden_ticks: 3, ..options() };
    let bundle =
        export(&support::untrained(ModelKind::Rcwm, 1), &folder.path().join("bundle"), &options).unwrap();
    let Values::U8(images) = bundle.golden.get("input/image").unwrap() else { panic!("images are bytes") };
    assert_eq!(*images, episode.image.slice(ndarray::s![..3, .., .., ..]).to_owned().into_dyn());
    let actions = bundle.golden.f32("input/action").unwrap();
    assert_eq!((actions[[0, 0]], actions[[1, 0]]), (0.0, 0.5));
    assert!(bundle.manifest.provenance.data.contains("the first 3 steps of the episode episode.npz"));
}

#[test]
fn the_commands_make_a_checkpoint_and_a_bundle() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rcwm-trainer"));
        command.current_dir(folder.path()).args(arguments).assert()
    };
    run(&["init", "--preset", "debug", "--seed", "3", "--out", "checkpoint"]).success();
    run(&["init", "--preset", "debug", "--out", "checkpoint"]).failure();
    run(&[
        "export",
        "--checkpoint",
        "checkpoint",
        "--out",
        "bundle",
        "--task",
        "hammer",
        "--json",
        "out.json",
    ])
    .success();
    assert!(folder.path().join("bundle").join(MANIFEST_FILE).is_file());
    let json: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.path().join("out.json")).unwrap()).unwrap();
    assert_eq!(json["parts"].as_array().unwrap().len(), 8);
    let refused =
        run(&["export", "--checkpoint", "checkpoint", "--out", "other", "--task", "hamer"]).failure();
    let text = String::from_utf8(refused.get_output().stderr.clone()).unwrap();
    assert!(text.contains("hammer") && text.lines().count() == 1, "{text}");
}
