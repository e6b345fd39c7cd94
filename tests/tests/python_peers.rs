//! The link spoken from Python (`runtime/python`), on either side.

use std::process::Command;
use std::time::Duration;

use rcwm_models::wire::{Action, ControllerLink, Wait};
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
    let mut command = domain.python(&root().join("runtime/python/examples/controller.py"));
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
    let mut command = domain.python(&root().join("runtime/python/examples/simulator.py"));
    command.args(["--instance", "python", "--episodes", "2", "--steps", "30", "--json"]).arg(&left);
    let mut simulator = Running::start(command);
    simulator.succeed();
    runtime.succeed();
    let (left, right) = (read_json(&left), read_json(&right));
    assert_eq!((&left["answers"], &left["actions_refused"]), (&60.into(), &0.into()));
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
    let mut command = domain.python(&root().join("runtime/python/examples/simulator.py"));
    command.args(["--instance", "python", "--episodes", "2", "--steps", "5", "--timeout-s", "20"]);
    let simulator = output(command);
    runtime.succeed();
    let said = String::from_utf8_lossy(&simulator.stderr);
    assert!(said.contains("the controller has closed"), "{said}");
    // And no other came.
    assert!(!simulator.status.success() && said.contains("no answer"), "{said}");
}

#[test]
fn a_python_robot_executes_no_action_that_is_not_finite_or_out_of_range() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let left = folder.path().join("simulator.json");
    let controller = ControllerLink::open(domain.link("python"), |_| Vec::new()).unwrap();
    let mut command = domain.python(&root().join("runtime/python/examples/simulator.py"));
    command.args(["--instance", "python", "--episodes", "1", "--steps", "3", "--json"]).arg(&left);
    let mut simulator = Running::start(command);
    let mut answers = 0;
    while let Wait::Message(observation) = controller.wait_observation(Duration::from_secs(20)).unwrap() {
        // The robot waits on: the next one may be fit.
        for bad in [f32::NAN, f32::INFINITY, 1.5, 0.5] {
            let action = [0.0, bad, 0.0, 0.0].into();
            let answers = observation.sequence;
            controller.send(&Action { answers, published_ns: 0, source: 0, action }).unwrap();
            // Only the newest action is kept: each is to be seen.
            std::thread::sleep(Duration::from_millis(20));
        }
        answers += 1;
    }
    simulator.succeed();
    let left = read_json(&left);
    assert_eq!((&left["answers"], &left["total_reward"].is_number()), (&answers.into(), &true), "{left}");
    assert!(left["actions_refused"].as_u64().unwrap() >= 3, "{left}");
}

#[test]
fn a_robot_of_the_python_package_with_an_interface_of_its_own_is_driven() {
    let (domain, interface) = (Domain::new(), root().join("models/src/interface/arm.toml"));
    let script = "import sys, numpy as np\n\
                  from rcwm.interface import load\n\
                  from rcwm.link import Flags, Header, RobotLink\n\
                  robot = load(sys.argv[1])\n\
                  link = RobotLink(robot, 'package')\n\
                  for step in range(3):\n \
                  header = Header(step, 0, step, Flags(1 if step == 0 else 0), 0.5, 7, 0, 0)\n \
                  image = np.full((128, 96, 3), step, np.uint8)\n \
                  link.publish(header, np.float32([0.1, 0.2]), np.float32([0.3, 0.4]), {'front': image}, {})\n \
                  answer = link.wait_action(20)\n \
                  while answer is not None and answer.answers != step: answer = link.wait_action(20)\n \
                  assert np.allclose(answer.action, [step / 10, -1]), answer\n\
                  link.close()";
    let mut command: Command = domain.python("-c".as_ref());
    command.arg(script).arg(&interface);
    let mut robot = Running::start(command);
    let controller = ControllerLink::open(domain.link("package"), |_| Vec::new()).unwrap();
    let format = controller.wait_robot(Duration::from_secs(20)).unwrap().expect("it says its interface");
    assert_eq!(format.interface(), &rcwm_models::interface::Interface::read(&interface).unwrap());
    let mut seen = 0;
    while let Wait::Message(observation) = controller.wait_observation(Duration::from_secs(20)).unwrap() {
        let (view, step) = (observation.view(), observation.step);
        assert_eq!((view.state(), view.executed()), (&[0.1, 0.2][..], &[0.3, 0.4][..]));
        assert!(view.image(0).iter().all(|byte| u32::from(*byte) == step) && view.captured_ns[0] == 7);
        let action = [step as f32 / 10.0, -1.0].into();
        controller
            .send(&Action { answers: observation.sequence, published_ns: 0, source: 0, action })
            .unwrap();
        seen = seen.max(step + 1);
    }
    assert_eq!(seen, 3);
    robot.succeed();
}

#[test]
fn an_episode_of_the_python_package_has_its_actions_from_limit_to_limit() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let file = folder.path().join("episode.npz");
    let script = "import sys, numpy as np\n\
                  from pathlib import Path\n\
                  from rcwm.episode import Recorder\n\
                  from rcwm.interface import parse\n\
                  robot = parse(open(sys.argv[1]).read().replace('128, 96, 3', '64, 64, 3'))\n\
                  seen = {'front': np.full((64, 64, 3), 9, np.uint8), 'front_mask': np.ones((64, 64), np.uint8)}\n\
                  seen['joint_pos'] = np.float32([0.1, 0.2])\n\
                  recorder = Recorder(robot)\n\
                  recorder.begin(seen)\n\
                  recorder.add(seen, np.float32([2.9, -0.85]), 1.0, True, False)\n\
                  recorder.finish().write(Path(sys.argv[2]))";
    let mut command: Command = domain.python("-c".as_ref());
    command.arg(script).arg(root().join("models/src/interface/arm.toml")).arg(&file);
    let told = output(command);
    assert!(told.status.success(), "{}", String::from_utf8_lossy(&told.stderr));
    let episode = rcwm_models::episode::Episode::read(&file).unwrap();
    assert_eq!(episode.action.as_slice().unwrap(), [0.0, 0.0, 1.0, -0.5]);
    assert_eq!(episode.proprio.unwrap().row(1).to_vec(), [0.1, 0.2]);
    assert!(episode.success[1] && episode.robot_mask.unwrap().iter().all(|pixel| *pixel));
}

#[test]
fn a_robot_of_one_s_own_in_python_is_driven_by_a_policy_for_its_interface() {
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let (model, bundle, json) =
        (folder.path().join("model"), folder.path().join("bundle"), folder.path().join("run.json"));
    let examples = root().join("runtime/python/examples");
    let mut init = domain.command("rcwm-trainer");
    init.args(["init", "--preset", "debug", "--set", "model.action=2", "--set", "model.state=2", "--out"]);
    init.arg(&model);
    Running::start(init).succeed();
    let mut export = domain.command("rcwm-trainer");
    export.args(["export", "--parts", "required", "--interface"]).arg(examples.join("table.toml"));
    export.arg("--checkpoint").arg(&model).arg("--out").arg(&bundle);
    Running::start(export).succeed();
    let mut command = domain.command("rcwm-runtime");
    command.args(["run", "--instance", "mine", "--bundle"]).arg(&bundle).arg("--json").arg(&json);
    let mut runtime = Running::start(command);
    let mut robot: Command = domain.python(&examples.join("robot.py"));
    robot.args(["--instance", "mine", "--episodes", "2"]);
    let told = output(robot);
    assert!(told.status.success(), "{}", String::from_utf8_lossy(&told.stderr));
    let counts: serde_json::Value = serde_json::from_slice(&told.stdout).unwrap();
    assert_eq!((&counts["episodes"], &counts["observations"]), (&2.into(), &102.into()), "{counts}");
    assert_eq!((&counts["rests"], &counts["refused_out_of_limits"]), (&0.into(), &0.into()), "{counts}");
    runtime.succeed();
    let run = read_json(&json);
    assert_eq!((&run["whole_episodes"], &run["counters"]["fallback_answers"]), (&2.into(), &0.into()));
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}
