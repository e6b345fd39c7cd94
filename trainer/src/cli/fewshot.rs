use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::settings::SettingsError;
use rcwm_models::tasks::task_id;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::replay::{Folder, Replay};
use rcwm_trainer::training::{
    Fewshot as Learning, Line, Phase, Reset, Run, TrainingError, TrainingSettings, demonstrations,
};

use super::bars::{self, absolute};

/// The paper's 1e-4 and 5e-5.
const ENVIRONMENT_OVER_ROBOT_RATE: f64 = 2.0;

/// Learn a task from demonstrations alone: environment's side, whole world model, then the actor
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer fewshot --from runs/small/checkpoints/last --data data/upstream --task \\
      button-press --out runs/button-press
  rcwm-trainer fewshot --from runs/small/checkpoints/last --data data/hammer --out runs/hammer \\
      --reset all-but-robot --set fewshot.environment_updates=600 --set \\
      fewshot.demonstrations=20 --separate-rates
  rcwm-trainer fewshot --out runs/button-press --resume

Only successful episodes are used. Every setting and its value is in settings.toml of the run's
folder. A resumed run gives the same weights, bit for bit, as one that was never interrupted, with
the same RAYON_NUM_THREADS.")]
pub struct Fewshot {
    /// Checkpoint of the pre-trained model
    #[arg(long, value_name = "CHECKPOINT", required_unless_present = "resume", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Folder of episodes, one sub-folder a task; with --resume, where it lies now
    #[arg(long, value_name = "DIR", required_unless_present = "resume")]
    data: Option<PathBuf>,
    /// The task whose demonstrations are used [default: all that --data has]
    #[arg(long, conflicts_with = "resume")]
    task: Option<String>,
    /// Folder of the run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Amounts to start from [default: those of the checkpoint's preset, else small]
    #[arg(long, value_enum, conflicts_with = "resume")]
    preset: Option<super::PresetName>,
    /// What of the model is drawn anew; the vanilla baseline keeps everything
    #[arg(long, value_enum, default_value = "none", conflicts_with = "resume")]
    reset: Reset,
    /// Learn the robot's side at half the rate of the environment's: with --reset all-but-robot the paper's transfer
    #[arg(long, conflicts_with = "resume")]
    separate_rates: bool,
    /// Change one setting, for example --set fewshot.actor_updates=2000 (repeatable)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Go on with the run in --out from its newest checkpoint
    #[arg(long)]
    resume: bool,
    #[command(flatten)]
    compute: super::ComputeArguments,
}

impl Fewshot {
    pub fn run(self) -> Result<ExitCode> {
        let compute = self.compute.compute()?;
        let device = compute.device();
        let stop = super::stop_on_ctrl_c()?;
        if !self.resume && self.out.join("settings.toml").exists() {
            return Err(TrainingError::Exists { path: self.out }.into());
        }
        let source = match (&self.from, self.resume) {
            (Some(from), false) => Some(Checkpoint::read(from, &device)?),
            _ => None,
        };
        let settings = self.settings(source.as_ref())?;
        settings.validate()?;
        let replay = load(&settings)?;
        let mut learning = match &source {
            Some(source) => Learning::create(&self.out, settings.clone(), source, compute)?,
            None => Learning::resume(&self.out, settings.clone(), compute)?,
        };
        let bar = bars::updates(settings.fewshot.updates(), learning.updates());
        let bar = bars::Bar::new(bar, "", "updates");
        let outcome = learning.run(replay, &stop, |progress| {
            bar.set_position(progress.updates);
            if let Some(line) = progress.line {
                bar.set_message(describe(line));
            }
        })?;
        bar.finish_and_clear();
        let out = self.out.display();
        if outcome.interrupted {
            rcwm_models::outln!(
                "stopped and saved after {} updates; go on with fewshot --resume --out {out}",
                outcome.updates
            );
        } else {
            rcwm_models::outln!(
                "{} updates; checkpoint in {}",
                outcome.updates,
                Run::last(&self.out).display()
            );
        }
        Ok(ExitCode::SUCCESS)
    }

    /// The settings of a new run, or those of the run to be resumed; with the overrides.
    fn settings(&self, source: Option<&Checkpoint>) -> Result<TrainingSettings> {
        let mut settings = match source {
            None => Run::settings(&self.out)?,
            Some(source) => {
                let mut settings = bars::settings_from(source, Phase::Fewshot, self.preset);
                settings.from = absolute(&Checkpoint::locate(self.from.as_deref().unwrap_or(&self.out))?)?;
                settings.reset.parts = self.reset;
                if self.separate_rates {
                    let world = &mut settings.world;
                    world.environment_learning_rate = world.adam.learning_rate;
                    world.adam.learning_rate /= ENVIRONMENT_OVER_ROBOT_RATE;
                }
                settings
            }
        };
        if let Some(data) = &self.data {
            settings.data = absolute(data)?;
        }
        if let Some(task) = &self.task {
            // A robot's own task is what its folder is called.
            if !settings.data.join(task).is_dir() {
                task_id(task).with_context(|| format!("{} has no folder {task}", settings.data.display()))?;
            }
            settings.task.clone_from(task);
        }
        let resolved = bars::changed(&settings, &self.overrides)?;
        if resolved.model != settings.model {
            let text = "the sizes of the model are those of the checkpoint: --set model... has no place here";
            return Err(SettingsError::Invalid(text.into()).into());
        }
        Ok(resolved)
    }
}

fn load(settings: &TrainingSettings) -> Result<Replay> {
    let fewshot = &settings.fewshot;
    bars::tell(&Folder::list_task(&settings.data, &settings.task)?.notes());
    let bar = ProgressBar::new(fewshot.demonstrations as u64)
        .with_style(ProgressStyle::with_template("loading {wide_bar} {pos}/{len} demonstrations")?);
    let bar = bars::Bar::new(bar, "loading", "demonstrations");
    let empty = Replay::new(settings.replay.capacity_steps).fitting(&settings.model);
    let replay = demonstrations(&settings.data, &settings.task, fewshot, empty, || bar.inc(1))?;
    bar.finish_and_clear();
    rcwm_models::outln!("{} demonstrations, {} steps", replay.episodes(), replay.steps());
    Ok(replay)
}

fn describe(line: &Line) -> String {
    let number = |name: &str, text: &str, digits: usize| {
        line.number(name).map_or_else(String::new, |value| format!(" {text} {value:.digits$}"))
    };
    format!(
        "{} {:.2} updates/s{}{}{}{}{}{}{}",
        line.phase,
        line.number("updates_per_second").unwrap_or_default(),
        number("waiting_share", "waiting", 2),
        number("losses.image", "image", 1),
        number("losses.reward", "reward", 3),
        number("losses.environment_kl", "kl", 2),
        number("losses.cloning", "cloning", 4),
        number("cloning.loss", "cloning", 4),
        number("cloning.imagined.lambda_return", "return", 2),
    )
}
