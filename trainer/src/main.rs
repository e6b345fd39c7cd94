//! `rcwm-trainer`: learns the Robo-Centric World Model and exports it.

mod cli;

use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use rcwm_models::errors::one_line;

fn main() -> ExitCode {
    rcwm_trainer::ops::leave_threads_to_ops();
    rcwm_trainer::ops::keep_freed_memory();
    // What standard output has lost is an error, too, but not the first to be told.
    let told = |code| rcwm_models::terminal::finish().context("standard output").map(|()| code);
    match cli::Arguments::parse().run().and_then(told) {
        Ok(code) => code,
        Err(error) => {
            rcwm_models::errln!("rcwm-trainer: {}", one_line(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}
