//! The library as cargo has just built it, installed for a test, and C and C++ programs that are compiled against it.

#![allow(dead_code, reason = "each test uses some of it")]
#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Mutex, OnceLock, PoisonError};

/// The crate's own.
pub fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// A library of this crate. Cargo builds all its kinds before a test, beside it: target/release/deps/librcwm.so.
pub fn built(library: &str) -> PathBuf {
    let path = std::env::current_exe().unwrap().with_file_name(library);
    assert!(path.is_file(), "{} is missing: cargo test builds it", path.display());
    path
}

/// What a command has printed; it must succeed.
pub fn succeed(command: &mut Command) -> String {
    let Output { status, stdout, stderr } =
        command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let (text, told) = (String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert!(status.success(), "{command:?}: {status}\n{text}{told}");
    text.into_owned()
}

/// Where the library is installed for the tests of this program.
pub fn installed() -> &'static Path {
    static PREFIX: OnceLock<tempfile::TempDir> = OnceLock::new();
    let prefix = PREFIX.get_or_init(|| {
        let prefix = tempfile::tempdir().unwrap();
        let mut install = Command::new(folder().join("../../scripts/install-capi"));
        succeed(install.arg(prefix.path()).arg("--built").arg(built("librcwm.so").parent().unwrap()));
        prefix
    });
    prefix.path()
}

/// What pkg-config says of the installed library.
pub fn pkg_config(arguments: &[&str]) -> Vec<String> {
    let mut command = Command::new("pkg-config");
    command.env("PKG_CONFIG_PATH", installed().join("lib/pkgconfig"));
    succeed(command.args(arguments).arg("rcwm")).split_whitespace().map(str::to_owned).collect()
}

/// A compiler as cautious as it can be.
fn compiler(source: &Path) -> Command {
    let is_cpp = source.extension().is_some_and(|extension| extension == "cpp");
    let (compiler, standard) = if is_cpp { ("c++", "-std=c++20") } else { ("cc", "-std=c11") };
    let mut command = Command::new(compiler);
    command.args([standard, "-Wall", "-Wextra", "-Werror", "-pedantic", "-g", "-O1"]);
    command
}

/// Address and undefined-behaviour sanitizers, where the compiler has them.
fn sanitizers() -> &'static [&'static str] {
    const FLAGS: &[&str] = &["-fsanitize=address,undefined", "-fno-sanitize-recover=all"];
    static HAS: OnceLock<bool> = OnceLock::new();
    let has = || {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("empty.c");
        std::fs::write(&source, "int main(void) { return 0; }").unwrap();
        let mut command = compiler(&source);
        command.args(FLAGS).arg(&source).arg("-o").arg(folder.path().join("empty"));
        command.output().is_ok_and(|output| output.status.success())
    };
    if *HAS.get_or_init(has) { FLAGS } else { &[] }
}

/// Where the programs of these tests are.
fn programs() -> &'static Path {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    FOLDER.get_or_init(|| tempfile::tempdir().unwrap()).path()
}

/// Compiles a program of `examples` or `tests/c` against the installed library, once.
pub fn compile(source: &str) -> PathBuf {
    static COMPILES: Mutex<()> = Mutex::new(());
    let _one_at_a_time = COMPILES.lock().unwrap_or_else(PoisonError::into_inner);
    let source = folder().join(source);
    let program = programs().join(source.file_stem().unwrap());
    if program.exists() {
        return program;
    }
    let mut command = compiler(&source);
    command.args(sanitizers()).args(pkg_config(&["--cflags"])).arg(&source).args(pkg_config(&["--libs"]));
    command.arg(format!("-Wl,-rpath,{}", installed().join("lib").display())).arg("-o").arg(&program);
    succeed(&mut command);
    program
}

/// The same against the static library, with what pkg-config says that it needs, and without sanitizers.
pub fn compile_static(source: &str) -> PathBuf {
    let source = folder().join(source);
    let program = programs().join("static");
    let libraries = pkg_config(&["--static", "--libs"]);
    // The shared one lies beside it.
    let libraries =
        libraries.into_iter().map(|word| if word == "-lrcwm" { "-l:librcwm.a".into() } else { word });
    let mut command = compiler(&source);
    command.args(pkg_config(&["--cflags"])).arg(&source).args(libraries).arg("-o").arg(&program);
    succeed(&mut command);
    program
}
