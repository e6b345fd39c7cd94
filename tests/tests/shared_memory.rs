//! A full `/dev/shm`, and another user's: one line that says what to do, never a signal. Needs a system that grants a mount namespace.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::process::{Command, Output};

use rcwm_tests::{Domain, binary, python, python_package, root, shipped_bundle};

/// Runs a script in a namespace whose shared memory is of so many KiB; none where the system grants no namespace.
fn with_memory(kib: u32, domain: &Domain, script: &str) -> Option<Output> {
    let mount = format!("mount -t tmpfs -o size={kib}k tmpfs /dev/shm");
    let granted = |flags: &[&str]| {
        Command::new("unshare")
            .args(flags)
            .args(["sh", "-c", &mount])
            .output()
            .is_ok_and(|o| o.status.success())
    };
    let flags = [&["-m"][..], &["-r", "-m"]].into_iter().find(|flags| granted(flags))?;
    let mut command = Command::new("unshare");
    command.args(flags).args(["sh", "-c", &format!("{mount} && {script}")]);
    command.env("RCWM_PREFIX", domain.prefix()).env("BUNDLE", shipped_bundle());
    command.env("PYTHON", python()).env("EXAMPLES", root().join("runtime/python/examples"));
    let package = python_package();
    command.env("PYTHONPATH", package.path());
    command.env("RUNTIME", binary("rcwm-runtime")).env("SIMULATOR", binary("rcwm-simulator"));
    Some(command.output().unwrap())
}

#[test]
fn a_full_shared_memory_is_one_line_with_the_remedy() {
    let run = "$RUNTIME run --bundle $BUNDLE --instance a --timeout 0.3";
    let serve = "$SIMULATOR serve --task reach --instance a --episodes 1 --wait-controller 1";
    let python_run = "$PYTHON $EXAMPLES/controller.py --instance a --timeout-s 0.3";
    let python_serve = "$PYTHON $EXAMPLES/simulator.py --instance a --episodes 1 --timeout-s 1";
    let rust = [(run, 4), (run, 16), (run, 40), (serve, 4), (serve, 64), (serve, 400)];
    let python = [(python_run, 16), (python_run, 40), (python_serve, 64), (python_serve, 400)];
    for (program, kib) in rust.into_iter().chain(python) {
        let domain = Domain::new();
        let Some(output) = with_memory(kib, &domain, program) else { return };
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{program} in {kib} KiB: {text}");
        assert!(text.contains("shared memory is full") && text.contains("--shm-size"), "{kib} KiB: {text}");
    }
}

#[test]
fn memory_that_was_granted_stays_when_others_fill_the_rest() {
    let domain = Domain::new();
    // What is left is filled as soon as both are connected; every page that the link will ever touch must be there by then.
    let script = "$SIMULATOR serve --task reach --instance a --episodes 1 --steps-max 30 --wait-controller 60 & \
                  sleep 1; (sleep 2; head -c 4000000 /dev/zero > /dev/shm/others-files) & \
                  $RUNTIME run --bundle $BUNDLE --instance a --timeout 60 --episodes 1; result=$?; wait %1; echo simulator $?; exit $result";
    let Some(output) = with_memory(700, &domain, script) else { return };
    let (told, text) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert!(told.contains("simulator 0"), "{told}{text}");
}
