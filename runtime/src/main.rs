//! `rcwm-runtime`, see [`rcwm_runtime::cli`].

fn main() -> std::process::ExitCode {
    rcwm_runtime::cli::main()
}
