//! The Python package's own tests, with the native module that cargo has built.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_tests::{Domain, output, root};

#[test]
fn the_python_package_passes_its_tests() {
    let domain = Domain::new();
    let mut command = domain.python("-m".as_ref());
    command.args(["pytest", "-q", "-p", "no:cacheprovider", "tests"]);
    command.current_dir(root().join("runtime/python")).env("PYTHONDONTWRITEBYTECODE", "1");
    let told = output(command);
    let (text, errors) = (String::from_utf8_lossy(&told.stdout), String::from_utf8_lossy(&told.stderr));
    assert!(told.status.success(), "{text}{errors}");
    // What needs an extra that is not there was skipped; not all do.
    assert!(text.contains(" passed"), "{text}");
}
