//! `rcwm-lab`, see [`rcwm_lab::cli`].

fn main() -> std::process::ExitCode {
    rcwm_lab::cli::main()
}
