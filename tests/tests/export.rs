//! From the trainer to both engines: exported parts against candle's own numbers, on images of a real episode.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::{Path, PathBuf};
use std::process::Command;

use rcwm_models::bundle::Bundle;
use rcwm_models::episode::Episode;
use rcwm_tests::{Domain, Running, binary, output, python, read_json, root, shipped_bundle};

fn succeed(mut command: Command) -> String {
    let name = format!("{:?} {:?}", command.get_program(), command.get_args().collect::<Vec<_>>());
    command.env("RUST_BACKTRACE", "0");
    let output = output(command);
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{name}:\n{out}{err}");
    out.into_owned()
}

fn trainer(arguments: &[&str]) -> Command {
    let mut command = Command::new(binary("rcwm-trainer"));
    command.args(arguments);
    command
}

/// An episode of the simulator, as the runtime recorded it.
fn recorded_episode(folder: &Path) -> PathBuf {
    let domain = Domain::new();
    let mut command = domain.command("rcwm-simulator");
    command.args(["serve", "--task", "door-open", "--instance", "record", "--episodes", "1", "--masks"]);
    let mut simulator = Running::start(command);
    let mut command = domain.command("rcwm-runtime");
    command
        .args(["run", "--instance", "record", "--bundle"])
        .arg(shipped_bundle())
        .arg("--record")
        .arg(folder);
    let mut runtime = Running::start(command);
    simulator.succeed();
    runtime.succeed();
    folder.join("episode-0000.npz")
}

#[test]
fn a_recorded_episode_becomes_the_golden_values_that_both_engines_reproduce() {
    let folder = tempfile::tempdir().unwrap();
    let recorded = recorded_episode(folder.path());
    let episode = Episode::read(&recorded).unwrap();
    assert_eq!(episode.len(), 251);
    assert!(episode.robot_mask.is_some() && episode.proprio.is_some());
    assert!(folder.path().join("episode-0000.gif").metadata().unwrap().len() > 10_000, "a film was written");

    for model in ["rcwm", "vanilla"] {
        check_model(model, &recorded, &folder.path().join(model));
    }
}

/// An untrained model of this kind, exported with golden values of the recorded episode.
fn check_model(model: &str, recorded: &Path, folder: &Path) {
    let (checkpoint, bundle) = (folder.join("checkpoint"), folder.join("bundle"));
    let (checkpoint, bundle) = (checkpoint.to_str().unwrap(), bundle.to_str().unwrap());
    succeed(trainer(&["init", "--preset", "debug", "--model", model, "--seed", "5", "--out", checkpoint]));
    let mut export = trainer(&["export", "--checkpoint", checkpoint, "--out", bundle, "--task", "door-open"]);
    export.args(["--golden-ticks", "250", "--golden-episode"]).arg(recorded);
    succeed(export);
    let opened = Bundle::open(Path::new(bundle)).unwrap();
    assert_eq!(opened.golden.u8("input/image").unwrap().shape()[0], 250);

    // The official checker with full shape inference, and ONNX Runtime from Python.
    let mut check = Command::new(python());
    check.arg(root().join("tests/python/check_bundle.py")).arg(bundle);
    succeed(check);

    // tract and ONNX Runtime from Rust: every part, and 250 recurrent ticks.
    let json = folder.join("verify.json");
    let mut verify = Command::new(binary("rcwm-runtime"));
    verify.args(["verify", "--engine", "all", "--bundle", bundle, "--json"]).arg(&json);
    succeed(verify);
    let report = read_json(&json);
    let engines = report["engines"].as_array().unwrap_or_else(|| panic!("{report}"));
    assert_eq!(engines.len(), 2, "ORT_DYLIB_PATH must name ONNX Runtime: {report}");
}

#[test]
fn the_authors_numbers_are_reproduced_and_a_wrong_weight_is_noticed() {
    let reference = root().join("tests/data/rcwm-small.safetensors");
    let printed = succeed(trainer(&["parity", reference.to_str().unwrap()]));
    for group in
        ["encoder", "observe", "decode", "heads", "actor", "critic", "imagine", "loss", "grad", "updated"]
    {
        assert!(printed.contains(group), "{group} is reported:\n{printed}");
    }
    let mut bytes = std::fs::read(&reference).unwrap();
    // The file ends with the contents of some weight or activation; either must be noticed.
    let position = bytes.len() - 1;
    bytes[position] ^= 0x40;
    let folder = tempfile::tempdir().unwrap();
    let changed = folder.path().join("changed.safetensors");
    std::fs::write(&changed, bytes).unwrap();
    let outcome = output(trainer(&["parity", changed.to_str().unwrap()]));
    assert_eq!(outcome.status.code(), Some(1), "{}", String::from_utf8_lossy(&outcome.stdout));
}

#[test]
fn the_paper_preset_has_the_papers_number_of_parameters() {
    for (model, total) in [("rcwm", "24.7 M"), ("vanilla", "19.1 M")] {
        let printed = succeed(trainer(&["parameters", "--preset", "paper", "--model", model]));
        assert!(printed.lines().last().unwrap().contains(total), "{printed}");
    }
}
