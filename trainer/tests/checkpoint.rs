//! A checkpoint is read whole or refused.

#![allow(clippy::unwrap_used)]

mod support;

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use rcwm_models::files::sha256_hex;
use rcwm_models::settings::ModelKind;
use rcwm_trainer::checkpoint::{Checkpoint, CheckpointError, SETTINGS_FILE};
use rcwm_trainer::model::parameters::ParameterError;

fn written(folder: &Path) -> Checkpoint {
    let checkpoint = support::untrained(ModelKind::Rcwm, 5);
    checkpoint.write(folder).unwrap();
    checkpoint
}

fn weights_files(folder: &Path) -> Vec<PathBuf> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.filter(|path| path.extension().is_some_and(|extension| extension == "safetensors")).collect()
}

fn read(folder: &Path) -> Result<Checkpoint, CheckpointError> {
    Checkpoint::read(folder, &Device::Cpu)
}

/// Writes changed weights with a checksum that fits them.
fn rewrite(folder: &Path, change: impl Fn(&mut HashMap<String, Tensor>)) {
    let file = weights_files(folder).remove(0);
    let mut tensors = candle_core::safetensors::load(&file, &Device::Cpu).unwrap();
    change(&mut tensors);
    fs::remove_file(&file).unwrap();
    let changed = folder.join("changed");
    candle_core::safetensors::save(&tensors, &changed).unwrap();
    let sha256 = sha256_hex(&fs::read(&changed).unwrap());
    fs::rename(changed, folder.join(format!("weights-{}.safetensors", &sha256[..16]))).unwrap();
    let settings = fs::read_to_string(folder.join(SETTINGS_FILE)).unwrap();
    let lines = settings.lines().map(|line| match line.starts_with("weights_sha256") {
        true => format!("weights_sha256 = {sha256:?}\n"),
        false => format!("{line}\n"),
    });
    fs::write(folder.join(SETTINGS_FILE), lines.collect::<String>()).unwrap();
}

#[test]
fn a_checkpoint_survives_the_disk_and_replaces_the_one_before() {
    let folder = tempfile::tempdir().unwrap();
    support::untrained(ModelKind::Rcwm, 4).write(folder.path()).unwrap();
    let checkpoint = written(folder.path());
    let back = read(folder.path()).unwrap();
    assert_eq!(back.settings.model, checkpoint.settings.model);
    for (name, var) in checkpoint.parameters.iter() {
        let values = |var: &candle_core::Var| var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(var), values(back.parameters.get(name).unwrap()), "{name}");
    }
    assert_eq!(weights_files(folder.path()).len(), 1);
}

#[test]
fn weights_that_do_not_fit_the_settings_are_refused_by_name() {
    let name = "actor.out.bias";
    let refused = |change: &dyn Fn(&mut HashMap<String, Tensor>)| {
        let folder = tempfile::tempdir().unwrap();
        written(folder.path());
        rewrite(folder.path(), change);
        match read(folder.path()) {
            Err(CheckpointError::Parameters(error)) => error,
            other => panic!("{:?}", other.map(|_| "accepted")),
        }
    };
    let replace = |tensor: Tensor| {
        refused(&move |tensors: &mut HashMap<String, Tensor>| {
            tensors.insert(name.into(), tensor.clone());
        })
    };
    let cpu = &Device::Cpu;
    let missing = refused(&|tensors| {
        tensors.remove(name);
    });
    assert!(matches!(missing, ParameterError::Missing { name: found, .. } if found == name));
    let shape = replace(Tensor::new(&[0f32; 9], cpu).unwrap());
    assert!(matches!(shape, ParameterError::Shape { found, .. } if found == [9]));
    let infinite =
        replace(Tensor::new(&[0f32, f32::INFINITY, 0.0, 0.0, 0.0, 0.0, f32::NAN, 0.0], cpu).unwrap());
    assert!(matches!(infinite, ParameterError::NotFinite { count: 2, .. }));
    let unknown = refused(&|tensors| {
        tensors.insert("extra".into(), Tensor::new(&[1f32], cpu).unwrap());
    });
    assert!(matches!(unknown, ParameterError::Unknown { name, .. } if name == "extra"));
}

#[test]
fn a_flipped_bit_and_a_truncated_file_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path());
    let file = weights_files(folder.path()).remove(0);
    let bytes = fs::read(&file).unwrap();
    let mut flipped = bytes.clone();
    *flipped.last_mut().unwrap() ^= 1;
    for damaged in [&flipped[..], &bytes[..bytes.len() - 1]] {
        fs::write(&file, damaged).unwrap();
        assert!(matches!(read(folder.path()), Err(CheckpointError::Checksum { .. })));
    }
    fs::remove_file(&file).unwrap();
    assert!(matches!(read(folder.path()), Err(CheckpointError::File(_))));
}

#[test]
fn settings_of_another_format_or_with_unknown_keys_or_odd_checksums_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path());
    let path = folder.path().join(SETTINGS_FILE);
    let text = fs::read_to_string(&path).unwrap();
    let with = |from: &str, to: &str| {
        fs::write(&path, text.replacen(from, to, 1)).unwrap();
        read(folder.path()).map(|_| "accepted").unwrap_err()
    };
    assert!(matches!(with("format = 1", "format = 2"), CheckpointError::Format { found: 2 }));
    assert!(matches!(with("units", "unitz"), CheckpointError::Settings(_)));
    assert!(matches!(with("deter = 32", "deter = 33"), CheckpointError::Settings(_)));
    assert!(matches!(
        with("weights_sha256 = \"", "weights_sha256 = \"../"),
        CheckpointError::NotADigest { .. }
    ));
}
