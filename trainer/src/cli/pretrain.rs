use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::{Context, Result};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use rcwm_models::terminal::LINE_EVERY;
use rcwm_trainer::replay::{Folder, Replay};
use rcwm_trainer::training::{
    HeldOutLosses, Line, Pretraining, Progress, Run, TrainingError, TrainingSettings,
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
  rcwm-trainer pretrain --preset small --data data/upstream --out runs/five --seeds 0,1,2,3,4 \\
      --device cuda

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
    /// Several runs of these seeds at once, each in a folder of --out: seed-0, seed-1, ... On a GPU they share the
    /// card, which one run of a small model leaves mostly idle
    #[arg(long, value_name = "N", value_delimiter = ',')]
    seeds: Vec<u64>,
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
        let outs: Vec<(PathBuf, Option<u64>)> = if self.seeds.is_empty() {
            vec![(self.out.clone(), None)]
        } else {
            self.seeds.iter().map(|seed| (self.out.join(format!("seed-{seed}")), Some(*seed))).collect()
        };
        let distinct: std::collections::BTreeSet<_> = self.seeds.iter().collect();
        anyhow::ensure!(
            distinct.len() == self.seeds.len(),
            "--seeds: every seed once, each is a run of its own"
        );
        let sets_seed = self.overrides.iter().any(|change| change.trim_start().starts_with("seed="));
        anyhow::ensure!(!sets_seed || self.seeds.is_empty(), "--set seed=... beside --seeds: leave one out");
        let stop = super::stop_on_ctrl_c()?;
        let mut settings: Vec<TrainingSettings> = Vec::with_capacity(outs.len());
        for (out, seed) in &outs {
            if !self.resume && out.join("settings.toml").exists() {
                return Err(TrainingError::Exists { path: out.clone() }.into());
            }
            let mut resolved = self.settings(out)?;
            resolved.seed = seed.unwrap_or(resolved.seed);
            resolved.validate()?;
            settings.push(resolved);
        }
        let Some(first) = settings.first() else { anyhow::bail!("--seeds: expected at least one") };
        let same = |other: &TrainingSettings| {
            let of = |settings: &TrainingSettings| {
                (settings.replay.capacity_steps, settings.replay.held_out_episodes)
            };
            (&other.data, &other.masks, of(other)) == (&first.data, &first.masks, of(first))
        };
        anyhow::ensure!(
            settings.iter().all(same),
            "the runs of --seeds learn from different data, or hold out other episodes; resume them one by one"
        );
        let computes = self.compute.computes(outs.len())?;
        let replay = load(first)?;
        let mut runs = Vec::with_capacity(outs.len());
        for (((out, _), settings), compute) in outs.iter().zip(settings).zip(computes) {
            let training = if self.resume {
                Pretraining::resume(out, settings.clone(), compute)
            } else {
                Pretraining::create(out, settings.clone(), compute)
            };
            let training = training.with_context(|| out.display().to_string())?;
            runs.push((out, training, bars::updates(settings.pretrain.updates, 0)));
        }
        let bars = MultiProgress::new();
        let outcomes = std::thread::scope(|scope| {
            let threads: Vec<_> = runs
                .into_iter()
                .map(|(out, mut training, bar)| {
                    let (bar, replay, stop) = (bars.add(bar), replay.clone(), &*stop);
                    let name = match out.file_name() {
                        Some(name) if !self.seeds.is_empty() => format!("{}: ", name.to_string_lossy()),
                        _ => String::new(),
                    };
                    bar.set_position(training.updates());
                    bar.reset_eta();
                    scope.spawn(move || {
                        let mut shown = Instant::now();
                        let outcome =
                            training.run(replay, stop, |progress| show(&bar, &name, &mut shown, progress));
                        // Whatever ends one run ends the others where they are, with a checkpoint each.
                        if outcome.is_err() {
                            stop.store(true, Ordering::Relaxed);
                        }
                        bar.finish_and_clear();
                        (out, outcome)
                    })
                })
                .collect();
            threads
                .into_iter()
                .map(|thread| thread.join().map_err(|_| anyhow::anyhow!("a run's thread panicked")))
                .collect::<Result<Vec<_>>>()
        })?;
        let mut failed = None;
        for (out, outcome) in outcomes {
            match outcome {
                Ok(outcome) if outcome.interrupted => {
                    rcwm_models::outln!(
                        "stopped and saved after {} updates; {}",
                        outcome.updates,
                        self.go_on()
                    );
                }
                Ok(outcome) => {
                    rcwm_models::outln!(
                        "{} updates; checkpoint in {}",
                        outcome.updates,
                        Run::last(out).display()
                    );
                }
                Err(error) => failed = Some(anyhow::Error::from(error).context(out.display().to_string())),
            }
        }
        match failed {
            None => Ok(ExitCode::SUCCESS),
            Some(error) => Err(error),
        }
    }

    /// How a run that was stopped goes on.
    fn go_on(&self) -> String {
        let seeds: Vec<String> = self.seeds.iter().map(u64::to_string).collect();
        let seeds = if seeds.is_empty() { String::new() } else { format!(" --seeds {}", seeds.join(",")) };
        format!("go on with --resume --out {}{seeds}", self.out.display())
    }

    /// The settings of a new run, or those of the run to be resumed; with the overrides.
    fn settings(&self, out: &Path) -> Result<TrainingSettings> {
        let mut settings = if self.resume {
            Run::settings(out)?
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
        let mut resolved = bars::changed(&settings, &self.overrides)?;
        if resolved.model != settings.model {
            resolved.preset = "custom".to_owned();
        }
        Ok(resolved)
    }
}

fn load(settings: &TrainingSettings) -> Result<Replay> {
    let masks = Some(settings.masks.as_path()).filter(|path| !path.as_os_str().is_empty());
    let folder = Folder::list(&settings.data, masks)?;
    bars::tell(&folder.notes());
    let bar = ProgressBar::new(folder.len() as u64)
        .with_style(ProgressStyle::with_template("loading {wide_bar} {pos}/{len} episodes")?);
    let bar = bars::Bar::new(bar, "loading", "episodes");
    let replay =
        folder.load(Replay::new(settings.replay.capacity_steps).fitting(&settings.model), || bar.inc(1))?;
    bar.finish_and_clear();
    let masked = replay.masked();
    rcwm_models::outln!(
        "{} episodes, {} steps of {} tasks; with masks {} episodes, {} steps",
        replay.episodes(),
        replay.steps(),
        replay.tasks().count(),
        masked.episodes(),
        masked.steps()
    );
    Ok(replay)
}

fn show(bar: &ProgressBar, name: &str, shown: &mut Instant, progress: &Progress<'_>) {
    bar.set_position(progress.updates);
    if let Some(line) = progress.line {
        bar.set_message(describe(line));
    }
    if bar.is_hidden() && shown.elapsed() >= LINE_EVERY {
        *shown = Instant::now();
        let (done, all) = (progress.updates, bar.length().unwrap_or_default());
        rcwm_models::errln!("{name}{done} of {all} updates, ETA {:.0?}  {}", bar.eta(), bar.message());
    }
    if let Some(HeldOutLosses { update, held_out, best }) = progress.held_out {
        let best = if *best { ", the best so far" } else { "" };
        let (total, image) = (held_out.total, held_out.image);
        bars::say(bar, &format!("{name}{update} updates: held-out loss {total:.1}, image {image:.1}{best}"));
    }
}

fn describe(line: &Line) -> String {
    let number = |name: &str| line.number(name).unwrap_or_default();
    let optional = |name: &str, text: &str, digits: usize| {
        line.number(name).map_or_else(String::new, |value| format!("{text}{value:.digits$}"))
    };
    format!(
        "{} {:.2} updates/s, waiting {:.0}%  total {:.1} image {:.1}{}{} reward {:.3} kl {:.2}{}",
        line.phase,
        number("updates_per_second"),
        100.0 * number("waiting_share"),
        number("losses.total"),
        number("losses.image"),
        optional("losses.robot_mask", " mask ", 1),
        optional("losses.state_loss", " state ", 2),
        number("losses.reward"),
        number("losses.robot_kl"),
        optional("losses.environment_kl", " + ", 2),
    )
}
