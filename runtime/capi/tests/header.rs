//! The committed header is the one that cbindgen makes of the sources, and the library exports what it declares and nothing else.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod support;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use support::{built, folder, succeed};

fn generated() -> String {
    let config = cbindgen::Config::from_file(folder().join("cbindgen.toml")).unwrap();
    // It follows the modules.
    let builder = cbindgen::Builder::new().with_config(config).with_src(folder().join("src/lib.rs"));
    let mut text = Vec::new();
    builder.generate().unwrap().write(&mut text);
    String::from_utf8(text).unwrap()
}

#[test]
fn the_committed_header_is_that_of_the_sources() {
    let path = folder().join("include/rcwm.h");
    let made = generated();
    if std::env::var_os("RCWM_RENEW_HEADER").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == made,
        "{} is not what the sources say; renew it: RCWM_RENEW_HEADER=1 cargo test --release -p rcwm-capi --test header",
        path.display()
    );
}

#[test]
fn the_header_tells_the_version_of_the_package() {
    let header = generated();
    for (part, version) in [
        ("MAJOR", env!("CARGO_PKG_VERSION_MAJOR")),
        ("MINOR", env!("CARGO_PKG_VERSION_MINOR")),
        ("PATCH", env!("CARGO_PKG_VERSION_PATCH")),
    ] {
        let line = format!("#define RCWM_VERSION_{part} {version}");
        assert!(header.lines().any(|found| found == line), "{line} (src/code.rs)");
    }
}

fn declared() -> BTreeSet<String> {
    let header = generated();
    let code = header.lines().filter(|line| !line.trim_start().starts_with("//"));
    let words = code.flat_map(|line| line.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == '(')));
    let called = words.filter_map(|word| word.split_once('(').map(|(name, _)| name.to_owned()));
    called.filter(|name| name.starts_with("rcwm_")).collect()
}

fn exported(library: &Path) -> BTreeSet<String> {
    let listed = succeed(Command::new("nm").args(["-D", "--defined-only"]).arg(library));
    listed.lines().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
}

#[test]
fn the_shared_library_exports_what_the_header_declares_and_nothing_else() {
    let declared = declared();
    assert!(declared.len() > 20, "{declared:?}");
    assert_eq!(exported(&built("librcwm.so")), declared);
}

#[test]
fn the_shared_library_is_told_by_its_minor_version() {
    let dynamic = succeed(Command::new("readelf").arg("-d").arg(built("librcwm.so")));
    let soname =
        format!("[librcwm.so.{}.{}]", env!("CARGO_PKG_VERSION_MAJOR"), env!("CARGO_PKG_VERSION_MINOR"));
    assert!(dynamic.contains(&soname), "{dynamic}");
    // Nothing that a machine with a C library lacks.
    let needed = dynamic.lines().filter(|line| line.contains("(NEEDED)"));
    for line in needed {
        let known =
            ["libc.so", "libm.so", "libgcc_s.so", "ld-linux", "libpthread.so", "libdl.so", "librt.so"];
        assert!(known.iter().any(|name| line.contains(name)), "{line}");
    }
}
