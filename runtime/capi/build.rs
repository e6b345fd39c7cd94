//! How the shared library is linked. Its soname: before 1.0 every minor version may break programs that were built with an earlier one. What
//! it exports: nothing of the crates that it is built of, some of which have symbols for C of their own.

fn main() {
    let [major, minor] = ["MAJOR", "MINOR"].map(|part| {
        std::env::var(format!("CARGO_PKG_VERSION_{part}")).expect("cargo says the package's version")
    });
    let version = if major == "0" { format!("0.{minor}") } else { major };
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,librcwm.so.{version}");
    println!("cargo::rustc-cdylib-link-arg=-Wl,--exclude-libs,ALL");
}
