//! The binary: verbs, exit codes, and errors that say what to do.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::process::Stdio;
use std::time::Duration;

use assert_cmd::Command;
use rcwm_models::files::sha256_hex;
use rcwm_models::tensors::{Tensors, Values};
use rcwm_testkit::{observation, own_link, smallest_bundle, with_manifest};
use rustix::process::{Pid, Signal, kill_process};

fn runtime() -> Command {
    Command::cargo_bin("rcwm-runtime").unwrap()
}

/// The one line on stderr of a command that fails with `code`.
fn error_of(command: &mut Command, code: i32) -> String {
    let output = command.assert().code(code).get_output().clone();
    let text = String::from_utf8(output.stderr).unwrap();
    let lines: Vec<_> = text.lines().filter(|line| line.starts_with("error: ")).collect();
    assert_eq!(lines.len(), 1, "{text}");
    lines[0].to_owned()
}

#[test]
fn a_bundle_that_is_not_there_is_one_line_that_says_how_to_make_one() {
    for verb in ["verify", "inspect", "bench"] {
        let error = error_of(runtime().args([verb, "--bundle", "no/such/bundle"]), 1);
        assert!(error.contains("no/such/bundle") && error.contains("rcwm-trainer export"), "{error}");
    }
}

#[test]
fn a_bundle_with_a_flipped_bit_is_refused_by_name() {
    let bundle = with_manifest(|_| {});
    let path = bundle.path().join("actor.onnx");
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let error = error_of(runtime().args(["verify", "--bundle"]).arg(bundle.path()), 1);
    assert!(error.contains("actor.onnx") && error.contains("sha256"), "{error}");
}

#[test]
fn the_shipped_bundle_verifies_and_one_with_another_start_does_not() {
    let json = tempfile::NamedTempFile::new().unwrap();
    let mut verify = runtime();
    verify.args(["verify", "--bundle"]).arg(smallest_bundle()).arg("--json").arg(json.path());
    verify.assert().success();
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json.path()).unwrap()).unwrap();
    assert_eq!(report["verified"], true);
    let error = error_of(runtime().args(["verify", "--bundle"]).arg(with_other_start().path()), 1);
    assert!(error.contains("NOT verified"), "{error}");
}

/// A bundle whose initial state is not the one its golden values start from.
fn with_other_start() -> tempfile::TempDir {
    let path = smallest_bundle().join("initial.safetensors");
    let mut tensors = Tensors::from_bytes(&std::fs::read(path).unwrap()).unwrap();
    let Some(Values::F32(h)) = tensors.0.get_mut("robot/h") else { panic!("robot/h is f32") };
    h.map_inplace(|value| *value += 0.01);
    let bytes = tensors.to_bytes().unwrap();
    let bundle = with_manifest(|manifest| {
        (manifest.initial.bytes, manifest.initial.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    });
    std::fs::write(bundle.path().join("initial.safetensors"), bytes).unwrap();
    bundle
}

#[test]
fn onnx_runtime_that_is_not_there_is_an_error_when_asked_for_by_name() {
    for (path, said) in [(None, "is not set"), (Some("/no/such/libonnxruntime.so"), "no such file")] {
        let mut command = runtime();
        command
            .env_remove("ORT_DYLIB_PATH")
            .args(["verify", "--engine", "ort", "--bundle"])
            .arg(smallest_bundle());
        if let Some(path) = path {
            command.env("ORT_DYLIB_PATH", path);
        }
        let error = error_of(&mut command, 1);
        assert!(error.contains("ORT_DYLIB_PATH") && error.contains(said), "{error}");
    }
}

#[test]
fn a_library_that_is_not_onnx_runtime_is_an_error_not_a_hang() {
    let not_a_library = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(not_a_library.path(), b"not a library").unwrap();
    let mut command = runtime();
    command.env("ORT_DYLIB_PATH", not_a_library.path());
    command.args(["verify", "--engine", "ort", "--bundle"]).arg(smallest_bundle());
    let error = error_of(&mut command, 1);
    assert!(error.contains("ORT_DYLIB_PATH"), "{error}");
}

/// The interface that messages of version 1 carry.
const ROBOT: &str = include_str!("../../models/src/interface/metaworld.toml");

#[test]
fn a_robot_that_fits_a_bundle_is_said_to() {
    let folder = tempfile::tempdir().unwrap();
    let (robot, json) = (folder.path().join("robot.toml"), folder.path().join("check.json"));
    std::fs::write(&robot, ROBOT).unwrap();
    let mut command = runtime();
    command.arg("check").arg(&robot).arg("--bundle").arg(smallest_bundle()).arg("--json").arg(&json);
    let output = String::from_utf8(command.assert().success().get_output().stdout.clone()).unwrap();
    assert!(output.contains("fits ") && output.contains("16576 bytes"), "{output}");
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    assert_eq!((&report["fits"], report["hash"].as_str().unwrap().len()), (&true.into(), 64));
}

#[test]
fn a_robot_that_does_not_fit_a_bundle_is_told_everything_that_differs() {
    let folder = tempfile::tempdir().unwrap();
    let robot = folder.path().join("robot.toml");
    for (from, to, expected) in [
        (
            "rate_hz = 40.0",
            "rate_hz = 20.0",
            "rate: the policy decides 40 times a second, the robot asks 20 times",
        ),
        (
            "[64, 64, 3]",
            "[128, 128, 3]",
            "camera image: size: the policy needs 64 x 64 x 3, the robot has 128 x 128 x 3",
        ),
        ("\"delta\"", "\"velocity\"", "action hand: mode: the policy needs delta, the robot has velocity"),
        (
            "high = [1.0, 1.0, 1.0, 1.0]",
            "high = [1.0, 1.0, 0.5, 1.0]",
            "action hand: limits of z: the policy needs -1 to 1, the robot has -1 to 0.5",
        ),
    ] {
        assert!(ROBOT.contains(from));
        std::fs::write(&robot, ROBOT.replace(from, to)).unwrap();
        let mut command = runtime();
        command.arg("check").arg(&robot).arg("--bundle").arg(smallest_bundle());
        let error = error_of(&mut command, 1);
        assert!(error.contains("does not fit") && error.contains("in 1 thing;"), "{error}");
        let output = String::from_utf8(command.assert().get_output().stdout.clone()).unwrap();
        assert!(output.contains(expected), "{expected}\nfound {output}");
    }
}

#[test]
fn what_is_no_interface_is_one_line_that_names_the_place() {
    let folder = tempfile::tempdir().unwrap();
    let robot = folder.path().join("robot.toml");
    for (text, expected) in [
        (ROBOT.replace("rate_hz = 40.0", "rate_hz = 0.0"), "rate_hz = 0; expected"),
        (format!("a = {}", "[".repeat(100_000)), "line 1"),
        (ROBOT.replace("unit", "units"), "unknown field"),
        ("x".repeat((1 << 20) + 1), "at most 1048576"),
        (String::new(), "missing field `interface`"),
    ] {
        std::fs::write(&robot, text).unwrap();
        let error = error_of(runtime().arg("check").arg(&robot), 1);
        assert!(error.contains(expected) && error.contains("robot.toml"), "{error}");
    }
}

#[test]
fn a_run_that_nobody_talks_to_ends_with_its_own_exit_code() {
    let link = own_link();
    let mut command = runtime();
    command.env("RCWM_PREFIX", link.prefix());
    command.args(["run", "--instance", "silent", "--timeout", "0.3", "--bundle"]).arg(smallest_bundle());
    let error = error_of(&mut command, 3);
    assert!(error.contains("rcwm-simulator serve --task TASK --instance silent"), "{error}");
}

#[test]
fn a_peer_that_falls_silent_ends_the_run_with_its_own_exit_code_and_what_was_granted_is_in_the_json() {
    let link = own_link();
    let peer = link.peer();
    peer.publish_copy(&observation(0, 0)).unwrap();
    let json = tempfile::NamedTempFile::new().unwrap();
    let mut command = runtime();
    command.env("RCWM_PREFIX", link.prefix());
    command.args([
        "run",
        "--instance",
        "test",
        "--silence-max",
        "0.3",
        "--threads",
        "1",
        "--cpu",
        "0",
        "--realtime",
        "--bundle",
    ]);
    command.arg(smallest_bundle()).arg("--json").arg(json.path());
    let answering = std::thread::spawn(move || error_of(&mut command, 5));
    // The controller says hello: it missed the first one.
    while !peer.poll_events().unwrap().hello {
        std::thread::sleep(Duration::from_millis(5));
    }
    peer.publish_copy(&observation(0, 0)).unwrap();
    let error = answering.join().unwrap();
    assert!(error.contains("has been silent for 0.3 s"), "{error}");
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json.path()).unwrap()).unwrap();
    assert_eq!(report["ended"], "peer_lost");
    let grants = report["realtime"]["grants"].as_array().unwrap();
    assert_eq!(grants.len(), 3);
    for grant in grants {
        assert!(grant["granted"].is_boolean() && !grant["detail"].as_str().unwrap().is_empty(), "{grant}");
    }
}

#[test]
fn a_core_that_does_not_exist_is_said_and_ends_the_run_only_where_it_is_required() {
    let link = own_link();
    for (required, code) in [(false, 3), (true, 1)] {
        let mut command = runtime();
        command.env("RCWM_PREFIX", link.prefix());
        command.args(["run", "--instance", "test", "--timeout", "0.2", "--cpu", "1023", "--bundle"]);
        command.arg(smallest_bundle());
        if required {
            command.arg("--realtime=require");
        }
        let error = error_of(&mut command, code);
        assert_eq!(error.contains("core 1023: refused"), required, "{error}");
    }
}

#[test]
fn inspect_counts_every_part_once() {
    let json = tempfile::NamedTempFile::new().unwrap();
    let mut inspect = runtime();
    inspect.args(["inspect", "--bundle"]).arg(smallest_bundle()).arg("--json").arg(json.path());
    inspect.assert().success();
    let info: serde_json::Value = serde_json::from_slice(&std::fs::read(json.path()).unwrap()).unwrap();
    let parts = info["parts"].as_array().unwrap();
    let in_tick = parts.iter().filter(|part| part["in_tick"] == true);
    let sum: u64 = in_tick.map(|part| part["parameters"].as_u64().unwrap()).sum();
    assert_eq!(info["tick"]["parameters"].as_u64().unwrap(), sum);
    assert!(sum > 0 && info["tick"]["flops"].as_u64().unwrap() > 0);
}

#[test]
fn what_an_engine_does_not_have_is_said_and_not_passed_over() {
    let refused = |options: &[&str]| {
        let mut command = runtime();
        command.args(["run", "--instance", "none", "--bundle"]).arg(smallest_bundle()).args(options);
        error_of(&mut command, 1)
    };
    assert!(refused(&["--threads", "5"]).contains("1 or 2 threads"));
    assert!(refused(&["--engine", "ort", "--half-weights"]).contains("only tract"));
}

#[test]
fn what_cannot_be_written_hides_neither_how_the_run_ended_nor_what_else_failed() {
    let link = own_link();
    let peer = link.peer();
    let mut command = runtime();
    command.env("RCWM_PREFIX", link.prefix());
    let folder = tempfile::tempdir().unwrap();
    command.args(["run", "--instance", "test", "--silence-max", "0.3"]);
    let place = folder.path().join("results");
    command.arg("--json").arg(place.join("a.json")).arg("--plot").arg(place.join("a.png"));
    command.arg("--bundle").arg(smallest_bundle());
    let answering = std::thread::spawn(move || command.assert().code(5).get_output().clone());
    while !peer.poll_events().unwrap().hello {
        std::thread::sleep(Duration::from_millis(5));
    }
    // Both could be written when the run began.
    std::fs::remove_dir_all(&place).unwrap();
    std::fs::write(&place, b"a file in the folder's place").unwrap();
    peer.publish_copy(&observation(0, 0)).unwrap();
    let text = String::from_utf8(answering.join().unwrap().stderr).unwrap();
    let errors: Vec<_> = text.lines().filter(|line| line.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 3, "{text}");
    for part in ["has been silent", "a.json", "--plot"] {
        assert!(errors.iter().any(|error| error.contains(part)), "{part}: {text}");
    }
}

/// A supervisor signals the process, then its group: the run still ends in order.
#[test]
fn two_signals_at_once_are_one() {
    let link = own_link();
    let peer = link.peer();
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_rcwm-runtime"));
    command.env("RCWM_PREFIX", link.prefix()).args([
        "run",
        "--instance",
        "test",
        "--timeout",
        "0",
        "--bundle",
    ]);
    command.arg(smallest_bundle()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut run = command.spawn().unwrap();
    while !peer.poll_events().unwrap().hello {
        std::thread::sleep(Duration::from_millis(5));
    }
    let id = Pid::from_child(&run);
    // Stopped, it gets both when it goes on.
    for signal in [Signal::STOP, Signal::TERM, Signal::INT, Signal::CONT] {
        kill_process(id, signal).unwrap();
    }
    assert_eq!(run.wait().unwrap().code(), Some(0));
}

/// Starts a run that is shown one observation, and ends it; gives what it has said.
fn shown_one_observation(arguments: &[&str], before: impl FnOnce(&rcwm_testkit::OwnLink)) -> (i32, String) {
    let link = own_link();
    before(&link);
    let peer = link.peer();
    let mut command = runtime();
    command.env("RCWM_PREFIX", link.prefix()).args(["run", "--instance", "test", "--bundle"]);
    command.arg(smallest_bundle()).args(arguments);
    let run = std::thread::spawn(move || command.output().unwrap());
    rcwm_testkit::ask(&peer, &observation(0, 0));
    peer.close().unwrap();
    let output = run.join().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_run_whose_swap_server_is_taken_goes_on_without_swaps_and_says_so() {
    use std::os::linux::net::SocketAddrExt;
    use std::os::unix::net::{SocketAddr, UnixListener};
    let mut taken = None;
    let (code, said) = shown_one_observation(&[], |link| {
        let name = rcwm_runtime::swap::name_of_server(&link.0);
        let address = SocketAddr::from_abstract_name(name).unwrap();
        taken = Some(UnixListener::bind_addr(&address).unwrap());
    });
    let lines: Vec<_> = said.lines().filter(|line| line.contains("no swaps")).collect();
    assert_eq!((code, lines.len()), (0, 1), "{said}");
    assert!(lines[0].contains("another run with this instance"), "{said}");
}

#[test]
fn a_run_takes_swaps_whether_it_records_or_not() {
    let folder = tempfile::tempdir().unwrap();
    let (code, said) = shown_one_observation(&["--record", folder.path().to_str().unwrap()], |_| {});
    assert!(code == 0 && !said.contains("no swaps"), "{said}");
    let (code, said) = shown_one_observation(&[], |_| {});
    assert!(code == 0 && !said.contains("no swaps"), "{said}");
}
