use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::settings;
use rcwm_trainer::replay::{Folder, Replay};
use rcwm_trainer::training::{
    HeldOutLosses, Metrics, Pretraining, Progress, Run, TrainingError, TrainingSettings,
};

use super::bars::{self, absolute};

/// Train a world model on recorded episodes: mask warm-up, then mask-free
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer pretrain --preset small --data data/upstream --out runs/small
  rcwm-trainer pretrain --preset small --model vanilla --data data/upstream --out runs/vanilla \\
      --set replay.batch=4
  rcwm-trainer pretrain --out runs/small --resume --set pretrain.updates=40000
  rcwm-trainer pretrain --preset paper --data data/upstream --out runs/paper --device cuda \\
      --precision tf32

Every setting and its value is in settings.toml of the run's folder; curves.png there and
TensorBoard (tensorboard --logdir runs) show how it goes. replay.held_out_episodes of each task
are not trained on: the best checkpoint is chosen by them. RAYON_NUM_THREADS sets the number of
threads; with the same number a resumed run gives the same weights, bit for bit, as one that was
never interrupted.")]
pub struct Pretrain {
    /// Sizes to start from
    #[arg(long, value_enum, default_value = "small", conflicts_with = "resume")]
    preset: super::PresetName,
    /// Which world model
    #[arg(long, value_enum, default_value = "rcwm", conflicts_with = "resume")]
    model: super::ModelName,
    /// Folder of episodes, one sub-folder a task
    #[arg(long, value_name = "DIR", required_unless_present = "resume")]
    data: Option<PathBuf>,
    /// Folder of masks as pictures, task/episode/*.png, in place of the episodes' own
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Folder of the run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Change one setting, for example --set replay.batch=4 (repeatable)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Go on with the run in --out from its newest checkpoint
    #[arg(long)]
    resume: bool,
    #[command(flatten)]
    compute: super::ComputeArguments,
}

impl Pretrain {
    pub fn run(self) -> Result<ExitCode> {
        let compute = self.compute.compute()?;
        let stop = super::stop_on_ctrl_c()?;
        let settings = self.settings()?;
        settings.validate()?;
        if !self.resume && self.out.join("settings.toml").exists() {
            return Err(TrainingError::Exists { path: self.out }.into());
        }
        let replay = load(&settings)?;
        let mut training = if self.resume {
            Pretraining::resume(&self.out, settings.clone(), compute)?
        } else {
            Pretraining::create(&self.out, settings.clone(), compute)?
        };
        let bar = bars::updates(settings.pretrain.updates, training.updates());
        let outcome = training.run(replay, &stop, |progress| show(&bar, progress))?;
        bar.finish_and_clear();
        let out = self.out.display();
        if outcome.interrupted {
            println!("stopped and saved after {} updates; go on with --resume --out {out}", outcome.updates);
        } else {
            println!("{} updates; checkpoint in {}", outcome.updates, Run::last(&self.out).display());
        }
        Ok(ExitCode::SUCCESS)
    }

    /// The settings of a new run, or those of the run to be resumed; with the overrides.
    fn settings(&self) -> Result<TrainingSettings> {
        let mut settings = if self.resume {
            Run::settings(&self.out)?
        } else {
            let data = self.data.clone().unwrap_or_default();
            TrainingSettings::preset(self.preset.preset(), self.model.kind(), absolute(&data)?)
        };
        if let (true, Some(data)) = (self.resume, &self.data) {
            settings.data = absolute(data)?;
        }
        if let Some(masks) = &self.masks {
            settings.masks = absolute(masks)?;
        }
        let mut resolved = settings::with_overrides(&settings, &self.overrides)?;
        if resolved.model != settings.model {
            resolved.preset = "custom".to_owned();
        }
        Ok(resolved)
    }
}

fn load(settings: &TrainingSettings) -> Result<Replay> {
    let masks = Some(settings.masks.as_path()).filter(|path| !path.as_os_str().is_empty());
    let folder = Folder::list(&settings.data, masks)?;
    let bar = ProgressBar::new(folder.len() as u64)
        .with_style(ProgressStyle::with_template("loading {wide_bar} {pos}/{len} episodes")?);
    let replay = folder.load(settings.replay.capacity_steps, || bar.inc(1))?;
    bar.finish_and_clear();
    let masked = replay.masked();
    println!(
        "{} episodes, {} steps of {} tasks; with masks {} episodes, {} steps",
        replay.episodes(),
        replay.steps(),
        replay.tasks().count(),
        masked.episodes(),
        masked.steps()
    );
    Ok(replay)
}

fn show(bar: &ProgressBar, progress: &Progress<'_>) {
    bar.set_position(progress.updates);
    if let Some(HeldOutLosses { update, held_out, best }) = progress.held_out {
        let best = if *best { ", the best so far" } else { "" };
        bar.println(format!(
            "{update} updates: held-out loss {:.1}, image {:.1}{best}",
            held_out.total, held_out.image
        ));
    }
    if let Some(metrics) = progress.metrics {
        bar.set_message(describe(metrics));
    }
}

fn describe(metrics: &Metrics) -> String {
    let losses = &metrics.losses;
    let optional = |name: &str, value: Option<f64>| {
        value.map_or_else(String::new, |value| format!(" {name} {value:.1}"))
    };
    format!(
        "{} {:.2} updates/s, waiting {:.0}%  total {:.1} image {:.1}{} reward {:.3} kl {:.2}{}",
        metrics.phase,
        metrics.updates_per_second,
        100.0 * metrics.waiting_share,
        losses.total,
        losses.image,
        optional("mask", losses.robot_mask),
        losses.reward,
        losses.robot_kl,
        losses.environment_kl.map_or_else(String::new, |kl| format!(" + {kl:.2}")),
    )
}
