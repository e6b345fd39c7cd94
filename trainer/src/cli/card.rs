use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use rcwm_models::bundle::Bundle;
use rcwm_models::files::{read_capped, write_atomic};
use rcwm_trainer::checkpoint::CheckpointSettings;
use rcwm_trainer::training::{Phase, Run, TrainingSettings};
use serde::Deserialize;

/// Largest file of results that is read, in bytes.
const RESULTS_BYTES_MAX: u64 = 64 << 20;

/// Write a bundle's card: what it learnt from, what that cost, how often it succeeds
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer card --run runs/hammer --bundle bundles/hammer --success runs/hammer/success.json \\
      --film episode-0000.gif

--success is what `evaluate --bundle BUNDLE --task TASK --json FILE` wrote. The card is README.md in
the bundle's folder; a film named with --film lies beside it.")]
pub struct Card {
    /// Folder of the few-shot run that the bundle came from
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Folder of the bundle
    #[arg(long, value_name = "BUNDLE")]
    bundle: PathBuf,
    /// Results of `evaluate --json`
    #[arg(long, value_name = "FILE")]
    success: PathBuf,
    /// File name of a film in the bundle's folder
    #[arg(long, value_name = "NAME")]
    film: Option<String>,
}

#[derive(Debug, Deserialize)]
struct Results {
    tasks: Vec<Scored>,
}

#[derive(Debug, Deserialize)]
struct Scored {
    settings: Scoring,
    episodes: u64,
    successes: u64,
    success_rate: f64,
    interval: Interval,
    return_mean: f64,
    return_std: f64,
}

#[derive(Debug, Deserialize)]
struct Scoring {
    task: String,
    seed: u64,
    disturb: String,
}

#[derive(Debug, Deserialize)]
struct Interval {
    low: f64,
    high: f64,
}

impl Card {
    pub fn run(self) -> Result<ExitCode> {
        let bundle = Bundle::open(&self.bundle)?;
        let settings = Run::settings(&self.run)?;
        ensure!(
            settings.phase == Phase::Fewshot,
            "--run {}: a run of {}, expected one of fewshot",
            self.run.display(),
            settings.phase.verb()
        );
        let learnt = checkpoint(&Run::last(&self.run))?;
        let pretrained = checkpoint(&settings.from).ok();
        let text = read_capped(&self.success, RESULTS_BYTES_MAX)?;
        let results: Results = serde_json::from_slice(&text).with_context(|| {
            format!("--success {}: no results of evaluate --task", self.success.display())
        })?;
        let path = self.bundle.join("README.md");
        let card = self.card(&bundle, &settings, &learnt, pretrained.as_ref(), &results)?;
        write_atomic(&path, card.as_bytes())?;
        println!("card in {}", path.display());
        Ok(ExitCode::SUCCESS)
    }

    fn card(
        &self,
        bundle: &Bundle,
        settings: &TrainingSettings,
        learnt: &CheckpointSettings,
        pretrained: Option<&CheckpointSettings>,
        results: &Results,
    ) -> Result<String> {
        let (task, model) = (&bundle.manifest.task, &learnt.model);
        let mut card = format!("# {task}\n\n");
        if let Some(film) = &self.film {
            ensure!(
                Path::new(film).file_name() == Some(film.as_ref()),
                "--film {film}: expected a file name"
            );
            ensure!(self.bundle.join(film).is_file(), "--film {film}: not in {}", self.bundle.display());
            card += &format!("![An episode of {task}, decided by this policy]({film})\n\n");
        }
        card += "| | |\n| --- | --- |\n";
        for scored in &results.tasks {
            card += &scored.row();
        }
        let (fewshot, kind) = (&settings.fewshot, format!("{:?}", model.kind).to_lowercase());
        card += &format!(
            "| demonstrations | {}, of the scripted expert |\n| updates | {} of the environment's side, {} of the whole world model, both with \
             the actor; {} of the actor alone |\n| processor time | {:.0} minutes, of all cores together |\n",
            fewshot.demonstrations,
            fewshot.environment_updates,
            fewshot.world_updates,
            fewshot.actor_updates,
            learnt.cpu_seconds / 60.0
        );
        card += &format!(
            "| model | {}, depth {}, {} x {} latents, width {} |\n",
            kind, model.cnn_depth, model.categoricals, model.classes, model.deter
        );
        if let Some(pretrained) = pretrained {
            card += &format!(
                "| pre-trained | {} updates on the four upstream tasks, {:.0} minutes of processor time |\n",
                pretrained.updates,
                pretrained.cpu_seconds / 60.0
            );
        }
        let seed = settings.seed;
        card += &format!("| seed | {seed} |\n\n");
        card += &format!(
            "Success counts where the task was solved at any step of the episode; the layouts of scoring were in no demonstration. Check and \
             run it:\n\n```sh\nrcwm-runtime verify --bundle {0}\nrcwm-trainer evaluate --bundle {0} --task {task} --episodes 50 --seed {1}\n```\n",
            format_args!("models/bundles/{task}"),
            results.tasks.first().map_or(0, |scored| scored.settings.seed),
        );
        Ok(card)
    }
}

impl Scored {
    fn row(&self) -> String {
        let Scoring { task, seed, disturb } = &self.settings;
        let disturbed = if disturb == "none" { String::new() } else { format!(", {disturb} disturbed") };
        let percent = |x: f64| format!("{:.0}%", 100.0 * x);
        format!(
            "| success, {task}{disturbed} | **{}** ({} of {}; 95% {} to {}), return {:.0} +- {:.0}, seed {seed} |\n",
            percent(self.success_rate),
            self.successes,
            self.episodes,
            percent(self.interval.low),
            percent(self.interval.high),
            self.return_mean,
            self.return_std
        )
    }
}

fn checkpoint(folder: &Path) -> Result<CheckpointSettings> {
    Ok(rcwm_models::settings::read(&folder.join(rcwm_trainer::checkpoint::SETTINGS_FILE))?)
}
