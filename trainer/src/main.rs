//! `rcwm-trainer`: learns the Robo-Centric World Model and exports it.

mod cli;

use std::process::ExitCode;

use clap::Parser;
use rcwm_models::errors::one_line;

fn main() -> ExitCode {
    rcwm_trainer::ops::leave_threads_to_ops();
    rcwm_trainer::ops::keep_freed_memory();
    match cli::Arguments::parse().run() {
        Ok(code) => code,
        Err(error) => {
            eprintln!("rcwm-trainer: {}", one_line(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}
