//! Notes the revision of the source for the bundles that the program exports.

use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=src");
    println!("cargo::rerun-if-changed=../models/src");
    let revision = git(&["rev-parse", "--short=12", "HEAD"]).map_or_else(
        || "unknown".to_owned(),
        |commit| {
            let changed =
                git(&["status", "--porcelain", "--", ".", "../models"]).is_none_or(|text| !text.is_empty());
            if changed { format!("{commit}-modified") } else { commit }
        },
    );
    println!("cargo::rustc-env=RCWM_SOURCE_REVISION={revision}");
}

/// What git prints, or nothing where there is no git or no repository.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
