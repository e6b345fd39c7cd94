use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use rcwm_models::settings::ModelSettings;
use rcwm_trainer::model::agent::{self, Part};
use serde::Serialize;

/// Print the parts of a model with their numbers of parameters
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer parameters --preset paper --model rcwm
  rcwm-trainer parameters --preset small --set cnn_depth=16 --json parameters.json")]
pub struct Parameters {
    #[command(flatten)]
    model: super::ModelArguments,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Table {
    settings: ModelSettings,
    parts: Vec<Part>,
    total: usize,
}

impl Parameters {
    pub fn run(self) -> Result<ExitCode> {
        let settings = self.model.settings()?;
        let parts = agent::parts(&settings)?;
        let total = parts.iter().map(|part| part.parameters).sum();
        println!("{:<24} {:>12}", "part", "parameters");
        for part in &parts {
            println!("{:<24} {:>12}", part.name, part.parameters);
        }
        println!("{:<24} {:>12}  ({:.1} M)", "total", total, total as f64 / 1e6);
        if let Some(path) = &self.json {
            super::write_json(path, &Table { settings, parts, total })?;
        }
        Ok(ExitCode::SUCCESS)
    }
}
