//! Acting and learning on a task, from a pre-trained model (`finetune`) or from scratch (`train`).

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Result;
use candle_core::Device;
use rcwm_models::settings::SettingsError;
use rcwm_models::tasks::task_id;
use rcwm_trainer::acting::check_acting;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::replay::Folder;
use rcwm_trainer::training::{
    EvaluationFacts, Finetuning, Line, OnlineOutcome, OnlineProgress, Phase, Run, TrainingError,
    TrainingSettings,
};

use super::bars::{self, absolute};
use super::collect;

/// What both verbs have.
#[derive(Debug, clap::Args)]
pub struct Online {
    /// The task
    #[arg(long, required_unless_present = "resume", conflicts_with = "resume")]
    pub task: Option<String>,
    /// Folder of the run
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of episodes to fill the replay with, instead of recording some: the first successful ones, and others as random steps
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Simulators that are started [default: the settings', 2]
    #[arg(long, value_name = "N")]
    pub simulators: Option<usize>,
    /// Act in a lock-step simulator that runs already, with --policy remote (repeatable)
    #[arg(long, value_name = "INSTANCE")]
    pub join: Vec<String>,
    /// Learn from robot masks that the simulators render (slower)
    #[arg(long, conflicts_with = "resume")]
    pub masks: bool,
    /// Seed of everything that is drawn
    #[arg(long, conflicts_with = "resume")]
    pub seed: Option<u64>,
    /// Change one setting, for example --set finetune.train_ratio=128 (repeatable)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Go on with the run in --out from its newest checkpoint; the simulators begin new episodes
    #[arg(long)]
    pub resume: bool,
    #[command(flatten)]
    compute: super::ComputeArguments,
}

impl Online {
    /// Runs the phase; `begin` gives the settings of a new run.
    pub fn run(
        &self,
        source: Option<&Checkpoint>,
        begin: impl FnOnce() -> Result<TrainingSettings>,
    ) -> Result<ExitCode> {
        let compute = self.compute.compute()?;
        let stop = super::stop_on_ctrl_c()?;
        if !self.resume && self.out.join("settings.toml").exists() {
            return Err(TrainingError::Exists { path: self.out.clone() }.into());
        }
        let settings = self.settings(begin)?;
        settings.validate()?;
        check_acting(&settings.model, settings.finetune.simulators > 0)?;
        let mut training = if self.resume {
            Finetuning::resume(&self.out, settings.clone(), compute)?
        } else {
            Finetuning::create(&self.out, settings.clone(), source, compute)?
        };
        let outcome = self.work(&mut training, &settings, &stop)?;
        self.summarise(&settings, &outcome);
        Ok(ExitCode::SUCCESS)
    }

    /// For a new run, the checkpoint that it starts from.
    pub fn source(&self, from: Option<&Path>) -> Result<Option<Checkpoint>> {
        match (from, self.resume) {
            (Some(from), false) => Ok(Some(Checkpoint::read(from, &Device::Cpu)?)),
            _ => Ok(None),
        }
    }

    fn settings(&self, begin: impl FnOnce() -> Result<TrainingSettings>) -> Result<TrainingSettings> {
        if let Some(task) = &self.task {
            task_id(task)?;
        }
        let mut settings = if self.resume { Run::settings(&self.out)? } else { begin()? };
        if let Some(data) = &self.data {
            settings.data = absolute(data)?;
        }
        if let Some(task) = &self.task {
            settings.task.clone_from(task);
        }
        if let Some(simulators) = self.simulators {
            settings.finetune.simulators = simulators;
        } else if !self.join.is_empty() && !self.resume {
            settings.finetune.simulators = 0;
        }
        settings.finetune.masks |= self.masks;
        settings.seed = self.seed.unwrap_or(settings.seed);
        if self.seed.is_some() && self.overrides.iter().any(|change| change.trim_start().starts_with("seed="))
        {
            anyhow::bail!("--set seed=... beside --seed: leave one out");
        }
        let resolved = bars::changed(&settings, &self.overrides)?;
        if resolved.model != settings.model && settings.phase == Phase::Finetune {
            let text = "the sizes of the model are those of the checkpoint: --set model... has no place here";
            return Err(SettingsError::Invalid(text.into()).into());
        }
        Ok(resolved)
    }

    fn work(
        &self,
        training: &mut Finetuning,
        settings: &TrainingSettings,
        stop: &AtomicBool,
    ) -> Result<OnlineOutcome> {
        let finetune = &settings.finetune;
        let random = finetune.random_steps.div_ceil(u64::from(finetune.episode_steps));
        if !settings.data.as_os_str().is_empty() {
            bars::tell(&Folder::list_task(&settings.data, &settings.task)?.notes());
        }
        let bar = collect::bar(finetune.expert_episodes + random, finetune.episode_steps)?;
        let filled = training.prefill(stop, &|seen| collect::advance(&bar, seen))?;
        bar.finish_and_clear();
        rcwm_models::outln!(
            "replay: {} episodes, {} steps; {} of them successful demonstrations",
            filled.replay.episodes(),
            filled.replay.steps(),
            filled.demonstrations
        );
        if stop.load(Ordering::Relaxed) {
            rcwm_models::outln!("stopped while the replay was filled; go on with --resume");
        }
        let state = training.state();
        let mut bar = Bars::new(settings, state.updates, state.policy_steps);
        let outcome = training.run(filled, &self.join, stop, |progress| bar.show(progress))?;
        bar.bar.finish_and_clear();
        drop(bar);
        Ok(outcome)
    }

    fn summarise(&self, settings: &TrainingSettings, outcome: &OnlineOutcome) {
        let rate = outcome.success_rate.map_or_else(String::new, |rate| {
            let newest = outcome.episodes.min(settings.finetune.success_episodes as u64);
            format!(", success in {:.0}% of the newest {newest}", 100.0 * rate)
        });
        let OnlineOutcome { updates, policy_steps, episodes, refused_actions, .. } = outcome;
        rcwm_models::outln!("{policy_steps} steps, {episodes} episodes{rate}; {updates} updates");
        if *refused_actions > 0 {
            rcwm_models::outln!("{refused_actions} actions were not finite; zeros were sent in their place");
        }
        let (verb, out) = (settings.phase.verb(), self.out.display());
        if outcome.interrupted {
            rcwm_models::outln!("stopped and saved; go on with {verb} --resume --out {out}");
        } else {
            rcwm_models::outln!("checkpoint in {}", Run::last(&self.out).display());
        }
    }
}

/// A bar of warm-up updates, then of steps.
struct Bars {
    bar: bars::Bar,
    /// The bar is one of the warm-up's updates.
    warms_up: bool,
    warm_up: u64,
    steps: u64,
}

impl Bars {
    fn new(settings: &TrainingSettings, updates: u64, steps: u64) -> Self {
        let warm_up = settings.finetune.warm_up_updates;
        let all = settings.finetune.steps;
        let (bar, unit) = match updates < warm_up {
            true => (bars::updates(warm_up, updates), "updates of the warm-up"),
            false => (bars::updates(all, steps), "steps"),
        };
        Self { bar: bars::Bar::new(bar, "", unit), warms_up: updates < warm_up, warm_up, steps: all }
    }

    fn show(&mut self, progress: &OnlineProgress<'_>) {
        if progress.updates < self.warm_up {
            self.bar.set_position(progress.updates);
        } else {
            if std::mem::take(&mut self.warms_up) {
                self.bar.finish_and_clear();
                self.bar = bars::Bar::new(bars::updates(self.steps, progress.policy_steps), "", "steps");
            }
            self.bar.set_position(progress.policy_steps);
        }
        if let Some(line) = progress.line {
            self.bar.set_message(describe(line, progress.success_rate));
        }
        if let Some(line) = progress.evaluation {
            let EvaluationFacts { policy_steps, episodes, successes, layouts, .. } = &line.evaluation;
            self.bar.println(format!(
                "after {policy_steps} steps: {successes} of {episodes} solved, layouts for {layouts}"
            ));
        }
        if let Some(line) = progress.episode {
            let facts = &line.episode;
            let solved = if facts.success { "solved" } else { "not solved" };
            let text = format!("episode {}: {solved}, return {:.1}", facts.number, facts.total_reward);
            self.bar.say(&text);
        }
    }
}

fn describe(line: &Line, success_rate: Option<f64>) -> String {
    let percent = |name: &str| 100.0 * line.number(name).unwrap_or_default();
    let number = |name: &str, text: &str, digits: usize| {
        line.number(name).map_or_else(String::new, |value| format!(" {text} {value:.digits$}"))
    };
    format!(
        "{} {:.2} updates/s, learning {:.0}%, acting {:.0}%, waiting for simulators {:.0}%{}{}{}{}{}",
        line.phase,
        line.number("updates_per_second").unwrap_or_default(),
        percent("learning_share"),
        percent("acting_share"),
        percent("waiting_for_simulators_share"),
        number("losses.image", "image", 1),
        number("losses.reward", "reward", 3),
        number("behaviour.lambda_return", "return", 2),
        number("behaviour.entropy", "entropy", 2),
        success_rate.map_or_else(String::new, |rate| format!(" success {:.0}%", 100.0 * rate)),
    )
}
