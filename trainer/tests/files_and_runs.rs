//! What people do with folders of runs: a run's folder for its checkpoint, two programs in one folder, pipes that close.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use candle_core::Device;
use rcwm_models::episode::Episode;
use rcwm_models::lock::Lock;
use rcwm_models::settings::{ModelKind, Preset};
use rcwm_trainer::checkpoint::{Checkpoint, SETTINGS_FILE};
use rcwm_trainer::training::{Pretraining, Run, TrainingError, TrainingSettings};

fn trainer(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rcwm-trainer"));
    command.args(arguments).stdin(Stdio::null());
    command
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn untrained(folder: &Path) {
    let output = trainer(&["init", "--preset", "debug", "--out"]).arg(folder).output().unwrap();
    assert!(output.status.success(), "{}", said(&output));
}

#[test]
fn a_run_stands_for_its_newest_checkpoint_and_what_is_none_says_what_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let last = run.join("checkpoints/last");
    untrained(&last);
    for path in [&run, &run.join("checkpoints"), &last, &last.join(SETTINGS_FILE)] {
        assert_eq!(
            fs::canonicalize(Checkpoint::locate(path).unwrap()).unwrap(),
            fs::canonicalize(&last).unwrap()
        );
        Checkpoint::read(path, &Device::Cpu).unwrap();
    }
    let refused = |path: &Path| Checkpoint::read(path, &Device::Cpu).unwrap_err().to_string();
    let other = folder.path().join("other");
    fs::create_dir(&other).unwrap();
    assert!(refused(&other).contains("checkpoints/last"), "{}", refused(&other));
    assert!(refused(&folder.path().join("nowhere")).contains("no such folder"));
    let torch = folder.path().join("latest.pt");
    fs::write(&torch, b"PK").unwrap();
    assert!(refused(&torch).contains("PyTorch"), "{}", refused(&torch));
    fs::write(other.join("settings.toml"), b"").unwrap();
    assert!(refused(&other).contains("no checkpoint yet"), "{}", refused(&other));
    fs::write(other.join("manifest.toml"), b"").unwrap();
    assert!(refused(&other).contains("bundle"), "{}", refused(&other));
}

#[test]
fn a_second_trainer_in_a_folder_is_refused_whatever_it_wants_to_do_there() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let settings = TrainingSettings::preset(Preset::Debug, ModelKind::Rcwm, folder.path().join("data"));
    let first = Pretraining::create(&run, settings.clone(), &Device::Cpu).unwrap();
    let again = Pretraining::resume(&run, settings.clone(), &Device::Cpu);
    assert!(matches!(again, Err(TrainingError::Lock(_))), "{:?}", again.err());
    drop(first);
    Pretraining::resume(&run, settings.clone(), &Device::Cpu).unwrap();
    // One that has just made the folder and has written nothing yet.
    let new = folder.path().join("new");
    fs::create_dir(&new).unwrap();
    let _lock = Lock::take(&new).unwrap();
    assert!(matches!(Run::create(&new, &settings), Err(TrainingError::Lock(_))));
}

#[test]
fn resuming_a_checkpoints_folder_names_the_runs() {
    let folder = tempfile::tempdir().unwrap();
    let last = folder.path().join("run/checkpoints/last");
    untrained(&last);
    fs::write(folder.path().join("run/settings.toml"), b"").unwrap();
    let error = Run::settings(&last).unwrap_err();
    assert!(matches!(&error, TrainingError::InsideARun { run, .. } if run.ends_with("run")), "{error}");
}

#[test]
fn a_data_folder_in_use_and_a_runs_own_folder_take_no_collection() {
    let folder = tempfile::tempdir().unwrap();
    let task = folder.path().join("data/reach");
    fs::create_dir_all(&task).unwrap();
    let _lock = Lock::take(&task).unwrap();
    let collect = |out: &Path| {
        let output =
            trainer(&["collect", "--task", "reach", "--random", "1", "--out"]).arg(out).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        said(&output)
    };
    let text = collect(&folder.path().join("data"));
    assert!(text.contains("in use"), "{text}");
    fs::write(folder.path().join("settings.toml"), b"").unwrap();
    let text = collect(&folder.path().join("data"));
    assert!(text.contains("holds a run"), "{text}");
}

#[test]
fn a_closed_pipe_costs_no_result_and_a_full_disk_is_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("not/yet/parameters.json");
    let command = || trainer(&["parameters", "--preset", "debug", "--json", json.to_str().unwrap()]);
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = command().stdout(writer).output().unwrap();
    assert!(output.status.success(), "{}", said(&output));
    fs::remove_file(&json).unwrap();
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = command().stdout(full).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said(&output).contains("standard output: No space left"), "{}", said(&output));
    assert!(json.is_file());
}

#[test]
fn demonstrations_are_never_those_of_evaluation() {
    let folder = tempfile::tempdir().unwrap();
    let episode = |reward: f32| {
        let mut episode = Episode::blank(14);
        episode.reward.fill(reward);
        episode.success[12] = true;
        episode
    };
    for (place, reward) in [("train_eps", 1.0), ("eval_eps", 2.0)] {
        let place = folder.path().join("base/reach").join(place);
        fs::create_dir_all(&place).unwrap();
        episode(reward).write(&place.join("a.npz")).unwrap();
    }
    untrained(&folder.path().join("checkpoint"));
    let mut command = trainer(&["fewshot", "--preset", "debug", "--task", "reach", "--from"]);
    command.arg(folder.path().join("checkpoint")).arg("--data").arg(folder.path().join("base"));
    command.arg("--out").arg(folder.path().join("run"));
    for change in ["environment_updates=1", "world_updates=1", "actor_updates=1"] {
        command.args(["--set", &format!("fewshot.{change}")]);
    }
    let output = command.args(["--set", "replay.length=4", "--set", "replay.batch=2"]).output().unwrap();
    assert!(output.status.success(), "{}", said(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("1 demonstrations, 14 steps"));
    assert!(said(&output).contains("left out:") && said(&output).contains("eval_eps"), "{}", said(&output));
}
