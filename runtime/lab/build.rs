//! Notes the revision of the source and the compiler, for what is measured.

use std::path::Path;
use std::process::Command;

/// Grows with every commit.
const GIT_LOG: &str = "../../.git/logs/HEAD";

fn main() {
    println!("cargo::rerun-if-changed=src");
    // A file that is missing would make every build start anew.
    if Path::new(GIT_LOG).exists() {
        println!("cargo::rerun-if-changed={GIT_LOG}");
    }
    let revision = said_by("git", &["describe", "--always", "--dirty", "--abbrev=12"]);
    let compiler = said_by(&std::env::var("RUSTC").unwrap_or_else(|_| "rustc".into()), &["--version"]);
    println!("cargo::rustc-env=RCWM_SOURCE_REVISION={}", revision.as_deref().unwrap_or("unknown"));
    println!("cargo::rustc-env=RCWM_COMPILER={}", compiler.as_deref().unwrap_or("unknown"));
}

fn said_by(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    (output.status.success() && !text.is_empty()).then_some(text)
}
