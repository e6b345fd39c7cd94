//! The wire spoken from Python (`runtime/examples/python`), on either side.

use rcwm_tests::{Domain, Running, output, read_json, root, shipped_bundle};

#[test]
fn a_python_controller_drives_the_simulator() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (left, right) = (folder.path().join("simulator.json"), folder.path().join("controller.json"));
    let mut command = domain.command("rcwm-simulator");
    command.args([
        "serve",
        "--task",
        "reach",
        "--instance",
        "python",
        "--episodes",
        "2",
        "--steps-max",
        "25",
        "--json",
    ]);
    command.arg(&left);
    let mut simulator = Running::start(command);
    let mut command = domain.python(&root().join("runtime/examples/python/controller.py"));
    command.args(["--instance", "python", "--json"]).arg(&right);
    let mut controller = Running::start(command);
    controller.succeed();
    simulator.succeed();
    let (left, right) = (read_json(&left), read_json(&right));
    assert_eq!(right["observations"], 2 * 26, "{right}");
    assert_eq!(right["gaps"], 0);
    assert_eq!(
        (&left["observations"], &left["actions_held"], &left["actions_refused"]),
        (&right["observations"], &0.into(), &0.into())
    );
    let returns: f64 = left["returns"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).sum();
    assert!((returns - right["total_reward"].as_f64().unwrap()).abs() < 1e-2, "{left} {right}");
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn a_python_simulator_is_driven_by_the_runtime() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (left, right) = (folder.path().join("simulator.json"), folder.path().join("runtime.json"));
    let mut command = domain.command("rcwm-runtime");
    command.args(["run", "--instance", "python", "--bundle"]).arg(shipped_bundle()).arg("--json").arg(&right);
    let mut runtime = Running::start(command);
    let mut command = domain.python(&root().join("runtime/examples/python/simulator.py"));
    command.args(["--instance", "python", "--episodes", "2", "--steps", "30", "--json"]).arg(&left);
    let mut simulator = Running::start(command);
    simulator.succeed();
    runtime.succeed();
    let (left, right) = (read_json(&left), read_json(&right));
    assert_eq!((&left["answers"], &left["actions_out_of_range"]), (&60.into(), &0.into()));
    assert_eq!(right["whole_episodes"], 2);
    assert_eq!(right["episodes"][0]["task"], "own");
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn a_python_robot_is_told_that_its_controller_has_closed() {
    let domain = Domain::new();
    let mut command = domain.command("rcwm-runtime");
    command.args(["run", "--instance", "python", "--episodes", "1", "--bundle"]).arg(shipped_bundle());
    let mut runtime = Running::start(command);
    let mut command = domain.python(&root().join("runtime/examples/python/simulator.py"));
    command.args(["--instance", "python", "--episodes", "2", "--steps", "5", "--timeout-s", "20"]);
    let simulator = output(command);
    runtime.succeed();
    let said = String::from_utf8_lossy(&simulator.stderr);
    assert!(said.contains("the controller has closed"), "{said}");
    // And no other came.
    assert!(!simulator.status.success() && said.contains("no answer"), "{said}");
}
