//! Bundles that are damaged, incomplete or hostile are refused with one clear line and a non-zero exit code.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::fs;
use std::path::Path;

use rcwm_models::files::sha256_hex;
use rcwm_tests::{Domain, output, shipped_bundle};

/// A copy of the shipped bundle, changed by `change`.
fn changed(change: impl FnOnce(&Path)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for entry in fs::read_dir(shipped_bundle()).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
    }
    change(folder.path());
    folder
}

fn edit_manifest(folder: &Path, edit: impl FnOnce(String) -> String) {
    let path = folder.join("manifest.toml");
    let before = fs::read_to_string(&path).unwrap();
    let after = edit(before.clone());
    assert_ne!(before, after, "the edit must change something");
    fs::write(path, after).unwrap();
}

/// Runs `verify` on the folder, which must fail with one line that holds every word of `words`.
fn assert_refused(folder: &Path, words: &[&str]) {
    for verb in ["verify", "inspect"] {
        let domain = Domain::new();
        let mut command = domain.command("rcwm-runtime");
        command.args([verb, "--bundle"]).arg(folder);
        let output = output(command);
        let line = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success(), "{verb} accepted it");
        assert!(output.status.code().is_some(), "{verb} was killed: {line}");
        assert_eq!(line.trim().lines().count(), 1, "{verb} must say one line:\n{line}");
        for word in words {
            assert!(line.contains(word), "{verb} must name {word:?}: {line}");
        }
    }
}

#[test]
fn the_shipped_bundle_is_accepted() {
    let domain = Domain::new();
    let mut command = domain.command("rcwm-runtime");
    command.args(["verify", "--engine", "tract", "--bundle"]).arg(shipped_bundle());
    let output = output(command);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn one_flipped_bit_in_a_part_is_refused() {
    let folder = changed(|folder| {
        let path = folder.join("robot.onnx");
        let mut bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(path, bytes).unwrap();
    });
    assert_refused(folder.path(), &["robot.onnx", "sha256"]);
}

#[test]
fn a_truncated_part_is_refused() {
    let folder = changed(|folder| {
        let path = folder.join("encoder.onnx");
        let bytes = fs::read(&path).unwrap();
        fs::write(path, &bytes[..bytes.len() - 1]).unwrap();
    });
    assert_refused(folder.path(), &["encoder.onnx", "size"]);
}

#[test]
fn a_missing_part_is_refused() {
    let folder = changed(|folder| fs::remove_file(folder.join("actor.onnx")).unwrap());
    assert_refused(folder.path(), &["actor.onnx"]);
}

#[test]
fn a_path_out_of_the_bundle_is_refused() {
    for outside in ["../robot.onnx", "/etc/passwd", "a/robot.onnx", ".."] {
        let folder = changed(|folder| {
            edit_manifest(folder, |text| text.replace("\"robot.onnx\"", &format!("{outside:?}")))
        });
        assert_refused(folder.path(), &[outside]);
    }
}

/// Stores of large files give links; what they lead to is checked as if it lay there.
#[test]
fn a_link_in_place_of_a_part_is_read_and_one_to_no_file_is_refused() {
    let linked = |to: &Path| {
        let to = to.to_path_buf();
        changed(move |folder| {
            fs::remove_file(folder.join("robot.onnx")).unwrap();
            std::os::unix::fs::symlink(to, folder.join("robot.onnx")).unwrap();
        })
    };
    let folder = linked(&shipped_bundle().join("robot.onnx"));
    rcwm_models::bundle::Bundle::open(folder.path()).unwrap();
    assert_refused(linked(&shipped_bundle().join("actor.onnx")).path(), &["robot.onnx"]);
    assert_refused(linked(Path::new("/dev/zero")).path(), &["robot.onnx", "not a plain file"]);
}

#[test]
fn another_format_and_an_unknown_key_are_refused() {
    let folder = changed(|folder| edit_manifest(folder, |text| text.replacen("format = 2", "format = 3", 1)));
    assert_refused(folder.path(), &["format 3"]);
    let folder = changed(|folder| edit_manifest(folder, |text| format!("surprise = 1\n{text}")));
    assert_refused(folder.path(), &["surprise"]);
}

#[test]
fn a_part_with_a_right_checksum_and_a_wrong_graph_is_refused() {
    let folder = changed(|folder| {
        let (robot, environment) = (folder.join("robot.onnx"), folder.join("environment.onnx"));
        let (old, new) = (fs::read(&robot).unwrap(), fs::read(&environment).unwrap());
        fs::write(&robot, &new).unwrap();
        edit_manifest(folder, |text| {
            text.replacen(&sha256_hex(&old), &sha256_hex(&new), 1).replacen(
                &format!("bytes = {}", old.len()),
                &format!("bytes = {}", new.len()),
                1,
            )
        });
    });
    assert_refused(folder.path(), &["robot", "inputs"]);
}

#[test]
fn wrong_golden_values_fail_the_verification() {
    let folder = changed(|folder| {
        let path = folder.join("golden.safetensors");
        let old = fs::read(&path).unwrap();
        let mut tensors = rcwm_models::tensors::Tensors::from_bytes(&old).unwrap();
        match tensors.0.get_mut("expect/actor/mean").unwrap() {
            rcwm_models::tensors::Values::F32(mean) => mean.mapv_inplace(|value| value + 0.01),
            other => panic!("the mean is {other:?}"),
        }
        let new = tensors.to_bytes().unwrap();
        fs::write(&path, &new).unwrap();
        edit_manifest(folder, |text| text.replacen(&sha256_hex(&old), &sha256_hex(&new), 1));
    });
    let domain = Domain::new();
    let mut command = domain.command("rcwm-runtime");
    command.args(["verify", "--engine", "tract", "--bundle"]).arg(folder.path());
    let output = output(command);
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).contains("actor"), "the part is named");
}
