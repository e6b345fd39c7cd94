//! What must never depend on what (ARCHITECTURE.md, invariants), asked of cargo and of the built binaries.

use std::process::Command;

use rcwm_tests::{binary, output, root};

/// The crates behind the words of the rule.
const CANDLE: &[&str] = &["candle-core", "candle-nn"];
const TRACT: &[&str] = &["tract-core", "tract-onnx"];
const PYTHON: &[&str] = &["pyo3", "pyo3-ffi"];
const DRAWING: &[&str] = &["image", "plotters", "gif", "png", "color_quant"];

/// What cargo would build for these packages, a line each in this format.
fn tree(packages: &[&str], edges: &str, format: &str) -> Vec<String> {
    let mut command = Command::new(env!("CARGO"));
    command
        .current_dir(root())
        .args(["tree", "--locked", "--edges", edges, "--prefix", "none", "--format", format]);
    packages.iter().for_each(|package| _ = command.args(["--package", package]));
    let output = output(command);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // A crate that was listed before is marked by a star.
    let text = String::from_utf8_lossy(&output.stdout).replace(" (*)", "");
    text.lines().filter(|line| !line.is_empty()).map(str::to_owned).collect()
}

fn normal_dependencies(package: &str) -> Vec<String> {
    let lines = tree(&[package], "normal,build", "{p}");
    lines.iter().filter_map(|line| line.split_whitespace().next()).map(str::to_owned).collect()
}

fn assert_without(package: &str, forbidden: &[&[&str]]) {
    let dependencies = normal_dependencies(package);
    assert!(dependencies.iter().any(|name| name == "rcwm-models"), "{package} was looked at");
    for name in forbidden.concat() {
        assert!(!dependencies.iter().any(|found| found == name), "{package} depends on {name}");
    }
}

#[test]
fn the_contract_depends_on_no_engine_and_no_python() {
    assert_without("rcwm-models", &[CANDLE, TRACT, PYTHON]);
}

#[test]
fn the_kernels_depend_on_no_engine_and_no_python() {
    let dependencies = normal_dependencies("rcwm-kernels");
    for name in [CANDLE, TRACT, PYTHON].concat() {
        assert!(!dependencies.iter().any(|found| found == name), "rcwm-kernels depends on {name}");
    }
    assert!(dependencies.iter().any(|name| name == "pulp"), "rcwm-kernels was looked at");
}

#[test]
fn what_runs_on_a_robot_depends_on_neither_candle_nor_python_and_draws_nothing() {
    assert_without("rcwm-runtime", &[CANDLE, PYTHON, DRAWING]);
}

#[test]
fn the_library_for_c_depends_on_neither_candle_nor_python_and_draws_nothing() {
    assert_without("rcwm-capi", &[CANDLE, PYTHON, DRAWING]);
}

#[test]
fn the_lab_depends_on_neither_candle_nor_python() {
    assert_without("rcwm-lab", &[CANDLE, PYTHON]);
}

#[test]
fn the_python_package_depends_on_python_and_not_on_candle() {
    assert_without("rcwm-python", &[CANDLE, DRAWING]);
    assert!(normal_dependencies("rcwm-python").iter().any(|name| name == "pyo3"), "it was looked at");
}

#[test]
fn the_trainer_depends_on_neither_tract_nor_python() {
    assert_without("rcwm-trainer", &[TRACT, PYTHON]);
}

#[test]
fn the_simulator_depends_on_neither_candle_nor_tract() {
    assert_without("rcwm-simulator", &[CANDLE, TRACT]);
}

#[test]
fn what_the_demo_compiles_is_not_compiled_again_for_learning() {
    let demo = ["rcwm-simulator", "rcwm-runtime", "rcwm-lab", "rcwm-capi"];
    let learning = [demo[0], demo[1], demo[2], demo[3], "rcwm-trainer"];
    // What is linked, and all that is built, procedural macros included: a crate may be both, with other features.
    for edges in ["normal,no-proc-macro", "normal,build"] {
        let with_features = |packages: &[&str]| tree(packages, edges, "{p} with {f}");
        let built = with_features(&learning);
        let again: Vec<_> = with_features(&demo).into_iter().filter(|line| !built.contains(line)).collect();
        assert!(
            built.len() > 100 && again.is_empty(),
            "built with other features beside the trainer: {again:?}"
        );
    }
}

#[test]
fn the_runtime_binary_loads_no_python() {
    let path = binary("rcwm-runtime");
    let mut command = Command::new("ldd");
    command.arg(&path);
    let listed = output(command);
    assert!(listed.status.success(), "ldd failed");
    let listed = String::from_utf8_lossy(&listed.stdout).to_lowercase();
    assert!(listed.contains("libc.so"), "ldd lists libraries:\n{listed}");
    assert!(!listed.contains("python"), "{listed}");
    let bytes = std::fs::read(&path).unwrap();
    let holds = |needle: &[u8]| bytes.windows(needle.len()).any(|window| window == needle);
    assert!(holds(b"tract"), "names of linked crates can be found in the binary");
    assert!(!holds(b"candle-core") && !holds(b"candle_core") && !holds(b"Py_Initialize"));
    println!("rcwm-runtime: {:.1} MB", bytes.len() as f64 / 1e6);
}
