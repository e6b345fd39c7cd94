//! Notes the revision of the source for the bundles that the program exports.

use std::path::Path;
use std::process::Command;

/// What the exported graphs depend on.
const SOURCES: [&str; 2] = ["src", "../models/src"];
/// Grows with every commit.
const GIT_LOG: &str = "../.git/logs/HEAD";

fn main() {
    println!("cargo::rerun-if-changed=src");
    println!("cargo::rerun-if-changed=../models/src");
    // A file that is missing would make every build start anew.
    if Path::new(GIT_LOG).exists() {
        println!("cargo::rerun-if-changed={GIT_LOG}");
    }
    println!("cargo::rustc-env=RCWM_SOURCE_REVISION={}", revision().as_deref().unwrap_or("unknown"));
}

/// The last commit that changed the sources, marked where they were changed since.
fn revision() -> Option<String> {
    let commit = git(&["log", "-1", "--abbrev=12", "--format=%h"]).filter(|commit| !commit.is_empty())?;
    let changed = git(&["status", "--porcelain"]).is_none_or(|text| !text.is_empty());
    Some(if changed { format!("{commit}-modified") } else { commit })
}

/// What git prints about the sources, or nothing where there is no git or no repository.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).arg("--").args(SOURCES).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
