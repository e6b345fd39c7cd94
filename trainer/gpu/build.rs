//! Compiles the kernels for the host, where tests run them without a GPU.

fn main() {
    let names = ["adam", "categorical", "conv", "heads", "interaction", "narrow", "norm", "product", "rows"];
    let mut build = cc::Build::new();
    build.std("gnu11").opt_level(3).flag("-ffp-contract=off").flag("-Wno-unused").cargo_metadata(true);
    for name in names {
        let path = format!("kernels/{name}.c");
        println!("cargo::rerun-if-changed={path}");
        build.file(path);
    }
    println!("cargo::rerun-if-changed=kernels/common.h");
    build.compile("rcwm_kernels_on_host");
}
