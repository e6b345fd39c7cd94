use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Result, ensure};
use rcwm_models::bundle::Bundle;
use rcwm_models::files::write_atomic;
use rcwm_trainer::checkpoint::CheckpointSettings;
use rcwm_trainer::evaluation::{ClosedLoopReport, ClosedLoopResults, ClosedLoopSettings};
use rcwm_trainer::replay::Replay;
use rcwm_trainer::training::{Phase, Run, TrainingSettings, demonstrations};

/// Write a bundle's card: what it learnt from, what that cost, how often it succeeds
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer card --run runs/hammer --bundle bundles/hammer \\
      --success runs/hammer/success.json \\
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
        let (results, _) = ClosedLoopResults::read(&self.success)?;
        ensure!(
            results.tasks.iter().any(|scored| scored.settings.task == bundle.manifest.task),
            "--success {}: no result on {}, the bundle's task; run evaluate --bundle {} --task {1} --json FILE",
            self.success.display(),
            bundle.manifest.task,
            self.bundle.display()
        );
        let path = self.bundle.join("README.md");
        let card = self.card(&bundle, &settings, &learnt, pretrained.as_ref(), &results)?;
        write_atomic(&path, card.as_bytes())?;
        rcwm_models::outln!("card in {}", path.display());
        Ok(ExitCode::SUCCESS)
    }

    fn card(
        &self,
        bundle: &Bundle,
        settings: &TrainingSettings,
        learnt: &CheckpointSettings,
        pretrained: Option<&CheckpointSettings>,
        results: &ClosedLoopResults,
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
            card += &row(scored);
        }
        let (fewshot, kind) = (&settings.fewshot, format!("{:?}", model.kind).to_lowercase());
        card += &format!(
            "| demonstrations | {} |\n| updates | {} of the environment's side, {} of the whole world model{}; {} of the actor alone |\n\
             | processor time | {} |\n",
            demonstrated(settings),
            fewshot.environment_updates,
            fewshot.world_updates,
            if fewshot.imitation_scale > 0.0 { ", both with the actor" } else { "" },
            fewshot.actor_updates,
            processor_time(learnt)
        );
        card += &format!(
            "| model | {}, depth {}, {} x {} latents, width {} |\n",
            kind, model.cnn_depth, model.categoricals, model.classes, model.deter
        );
        if let Some(pretrained) = pretrained {
            card += &format!(
                "| pre-trained | {} updates on {}; processor time: {} |\n",
                pretrained.updates,
                pretrained.data,
                processor_time(pretrained)
            );
        }
        if settings.average_decay > 0.0 {
            let decay = settings.average_decay;
            card += &format!("| weights | running average over the updates, decay {decay} |\n");
        }
        let seed = settings.seed;
        card += &format!("| seed | {seed} |\n\n");
        card += "Success counts where the task was solved at any step of the episode. Check and score it; BUNDLE is this folder:\n\n```sh\n\
                 rcwm-runtime verify --bundle BUNDLE\n";
        for ClosedLoopReport { settings, episodes, .. } in &results.tasks {
            let ClosedLoopSettings { task, layouts, seed, disturb, .. } = settings;
            card += &format!(
                "rcwm-trainer evaluate --bundle BUNDLE --task {task} --episodes {episodes} --layouts {layouts} --seed {seed} --disturb {disturb}\n"
            );
        }
        card += "```\n";
        Ok(card)
    }
}

fn processor_time(checkpoint: &CheckpointSettings) -> String {
    match checkpoint.cpu_seconds {
        0.0 => "not known".to_owned(),
        seconds => format!("{:.0} minutes, of all cores together", seconds / 60.0),
    }
}

fn row(scored: &ClosedLoopReport) -> String {
    let ClosedLoopSettings { task, layouts, seed, disturb, .. } = &scored.settings;
    let disturbed = if disturb == "none" { String::new() } else { format!(", {disturb} disturbed") };
    let percent = |x: f64| format!("{:.0}%", 100.0 * x);
    format!(
        "| success, {task}{disturbed} | **{}** ({} of {}; 95% {} to {}), return {:.0} +- {:.0}, layouts for {layouts}, seed {seed} |\n",
        percent(scored.success_rate),
        scored.successes,
        scored.episodes,
        percent(scored.interval.low),
        percent(scored.interval.high),
        scored.return_mean,
        scored.return_std
    )
}

/// How many demonstrations were learnt from, and what they were where they are still there.
fn demonstrated(settings: &TrainingSettings) -> String {
    let count = settings.fewshot.demonstrations;
    let Ok(replay) = demonstrations(
        &settings.data,
        &settings.task,
        &settings.fewshot,
        Replay::new(settings.replay.capacity_steps),
        || (),
    ) else {
        return format!("at most {count}");
    };
    let episodes = || replay.tasks().flat_map(|(_, episodes)| episodes);
    let pushed: usize =
        episodes().map(|episode| episode.pushed.iter().filter(|pushed| **pushed).count()).sum();
    format!(
        "{}, of {} steps; in {pushed} of these the demonstrator was pushed off course, to show how to recover",
        replay.episodes(),
        replay.steps()
    )
}

fn checkpoint(folder: &Path) -> Result<CheckpointSettings> {
    Ok(rcwm_models::settings::read(&folder.join(rcwm_trainer::checkpoint::SETTINGS_FILE))?)
}
