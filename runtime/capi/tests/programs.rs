//! Programs in C and C++, compiled as cautiously as the compiler can, against the library that cargo has built: the examples, what is
//! misused, and robots that fail while a real controller drives them.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;

use rcwm_tests::{Domain, Observer, Running, read_json, shipped_bundle};
use rustix::process::Signal;
use support::{compile, compile_static, folder, installed, succeed};

fn table() -> PathBuf {
    folder().join("examples/table.toml")
}

/// The controller of an instance; it ends with its robot.
fn controller(domain: &Domain, json: &Path) -> Running {
    let mut command = domain.command("rcwm-runtime");
    command.args(["run", "--instance", "table", "--timeout", "120", "--bundle"]).arg(shipped_bundle());
    Running::start({
        command.arg("--json").arg(json);
        command
    })
}

fn in_domain(domain: &Domain, program: &Path) -> Command {
    let mut command = Command::new(program);
    command.env("RCWM_PREFIX", domain.prefix());
    command
}

#[test]
fn the_robot_in_cpp_is_driven_in_lockstep_and_in_real_time() {
    let program = compile("examples/robot.cpp");
    for realtime in [false, true] {
        let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
        let json = folder.path().join("runtime.json");
        let mut runtime = controller(&domain, &json);
        let mut robot = in_domain(&domain, &program);
        robot.arg("table").arg(table()).args(["2", "15"]).args(realtime.then_some("--realtime"));
        let mut robot = Running::start(robot);
        robot.succeed();
        let text = robot.printed();
        assert!(text.contains("episodes 2, observations 32, answers "), "{text}");
        assert!(realtime || text.contains("answers 32, rests 0, missed 0"), "{text}");
        runtime.succeed();
        let report = read_json(&json);
        assert_eq!(
            (&report["whole_episodes"], &report["counters"]["refused_observations"]),
            (&2.into(), &0.into())
        );
        assert!(realtime || report["counters"]["answers"] == 32, "{report}");
        assert_eq!(domain.leftovers(), Vec::<String>::new());
    }
}

#[test]
fn ctrl_c_brings_the_robot_in_cpp_to_rest_and_tells_the_controller() {
    let program = compile("examples/robot.cpp");
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let json = folder.path().join("runtime.json");
    let observer = Observer::new(&domain, "table");
    let mut runtime = controller(&domain, &json);
    let mut robot = in_domain(&domain, &program);
    robot.arg("table").arg(table()).args(["0", "0"]);
    let mut robot = Running::start(robot);
    observer.wait_for(|observation| observation.step >= 20);
    drop(observer);
    robot.signal(Signal::INT);
    robot.succeed();
    assert!(robot.printed().contains("episodes 0, observations "), "{}", robot.printed());
    runtime.succeed();
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn robots_that_fail_come_to_rest_and_say_why() {
    let program = compile("tests/c/robots.cpp");
    for (mode, words) in [
        ("throws", "RCWM_ERROR_ROBOT: the robot failed in episode 0: the brakes are on"),
        ("throws-a-number", "an exception that is no std::exception"),
        ("no-camera", "the robot has no camera of this number"),
        (
            "nan",
            "RCWM_ERROR_NOT_FINITE: the robot measured a number that is not finite at step 2 of episode 0",
        ),
        ("reenters", "index is null"),
        ("stops", ""),
        ("own-loop", "answers 12"),
    ] {
        let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
        let json = folder.path().join("runtime.json");
        let mut runtime = controller(&domain, &json);
        let mut robot = in_domain(&domain, &program);
        robot.arg(mode).arg("table").arg(table());
        let mut robot = Running::start(robot);
        robot.succeed();
        let text = robot.printed();
        assert!(text.contains(words) && text.contains("all as expected"), "{mode}: {text}");
        // It was told that its robot has left.
        runtime.succeed();
        assert_eq!(domain.leftovers(), Vec::<String>::new(), "{mode}");
    }
}

#[test]
fn what_is_misused_is_found_and_changes_nothing() {
    let program = compile("tests/c/misuse.c");
    let (domain, folder) = (Domain::new(), tempfile::tempdir().unwrap());
    let broken = folder.path().join("broken.toml");
    std::fs::write(&broken, "[interface]\nname = \n").unwrap();
    let mut command = in_domain(&domain, &program);
    let text = succeed(command.arg(shipped_bundle()).arg("misused").arg(table()).arg(broken));
    assert!(text.contains("all as expected"), "{text}");
    assert_eq!(domain.leftovers(), Vec::<String>::new());
}

#[test]
fn the_policy_in_c_decides_the_same_from_the_shared_and_from_the_static_library() {
    let decided = |program: &PathBuf| {
        let text = succeed(Command::new(program).arg(shipped_bundle()));
        assert_eq!(text.lines().filter(|line| line.starts_with("step ")).count(), 50, "{text}");
        text
    };
    let alone = compile_static("examples/policy.c");
    assert_eq!(decided(&compile("examples/policy.c")), decided(&alone));
    let needed = succeed(Command::new("readelf").arg("-d").arg(&alone));
    assert!(!needed.contains("librcwm"), "{needed}");
    let segments = succeed(Command::new("readelf").arg("-lW").arg(&alone));
    let stack = segments.lines().find(|line| line.contains("GNU_STACK"));
    assert!(stack.is_some_and(|line| !line.contains("RWE")), "{segments}");
}

#[test]
fn cmake_finds_what_was_installed() {
    if Command::new("cmake").arg("--version").output().is_err() {
        println!("cmake is not installed: not tried");
        return;
    }
    let project = tempfile::tempdir().unwrap();
    let text = format!(
        "cmake_minimum_required(VERSION 3.16)\nproject(table C CXX)\nset(CMAKE_CXX_STANDARD 20)\nfind_package(rcwm {} REQUIRED)\n\
         add_executable(robot {robot})\ntarget_link_libraries(robot rcwm::rcwm)\n\
         add_executable(policy {policy})\ntarget_link_libraries(policy rcwm::static)\n",
        env!("CARGO_PKG_VERSION"),
        robot = folder().join("examples/robot.cpp").display(),
        policy = folder().join("examples/policy.c").display(),
    );
    std::fs::write(project.path().join("CMakeLists.txt"), text).unwrap();
    let build = project.path().join("build");
    let prefix = format!("-DCMAKE_PREFIX_PATH={}", installed().display());
    succeed(Command::new("cmake").arg("-S").arg(project.path()).arg("-B").arg(&build).arg(prefix));
    succeed(Command::new("cmake").arg("--build").arg(&build));
    let text = succeed(Command::new(build.join("policy")).arg(shipped_bundle()));
    assert!(text.contains("step 49"), "{text}");
}
