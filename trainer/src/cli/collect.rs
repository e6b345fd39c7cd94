use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::tasks::{DOWNSTREAM, UPSTREAM, task_id};
use rcwm_trainer::simulators::{
    Amounts, CollectSettings, Collected, DISTURBANCES, Plan, Progress, Sums, collect, collect_disturbed,
    record,
};
use serde::Serialize;

use super::bars::Bar;

/// Record episodes of Meta-World, as Dreamer's .npz files in one folder a task
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer collect --task upstream --expert 50 --mixed 28 --random 8 --masks 4 --out data
  rcwm-trainer collect --task hammer --expert 50 --out data/hammer
  rcwm-trainer collect --task hammer --pushed 70 --beside varied --out data/hammer-looks
  rcwm-trainer collect --join arm1 --episodes 10 --out data/arm1

The simulators are started and stopped here; --join records one that runs already. Episodes that
--out holds already are not recorded again: after Ctrl-C the same command goes on. Another --seed
gives other layouts and is added to what is there.")]
pub struct Collect {
    /// A task's name, `upstream` (the paper's four) or `downstream` (its eight); repeatable
    #[arg(long = "task", value_name = "TASK", required_unless_present = "join")]
    tasks: Vec<String>,
    /// Folder of the data
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Episodes of each task by the scripted expert
    #[arg(long, default_value_t = 0, value_name = "N")]
    expert: u64,
    /// Episodes of each task by the expert with noise and bursts of random actions
    #[arg(long, default_value_t = 0, value_name = "N")]
    mixed: u64,
    /// Episodes of each task with random actions
    #[arg(long, default_value_t = 0, value_name = "N")]
    random: u64,
    /// Episodes of each task by the expert, pushed off course now and then: demonstrations of how to recover
    #[arg(long, default_value_t = 0, value_name = "N")]
    pushed: u64,
    /// How many of each task's episodes have robot masks (slower); spread over the three kinds
    #[arg(long, default_value_t = 0, value_name = "N")]
    masks: u64,
    /// Layouts and scripted decisions depend on this
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Simulators at a time [default: one a core]
    #[arg(long, value_name = "N", conflicts_with = "join")]
    simulators: Option<usize>,
    /// Decisions in an episode
    #[arg(long, default_value_t = 250, value_name = "N", conflicts_with = "join",
        value_parser = clap::value_parser!(u32).range(1..=250))]
    steps_max: u32,
    /// Visual disturbance
    #[arg(long, default_value = "none", conflicts_with = "join", value_parser = DISTURBANCES)]
    disturb: String,
    /// Add to every episode what it looks like with this disturbance: the script does the same once more. What is learned
    /// from can be seen so (replay.look), and drawn as it is
    #[arg(long, value_name = "DISTURBANCE", value_parser = DISTURBANCES)]
    beside: Option<String>,
    /// Record a simulator that runs already; it gets random actions where it waits for a policy
    #[arg(long, value_name = "INSTANCE", conflicts_with_all = ["tasks", "expert", "mixed", "pushed", "random", "masks", "beside"])]
    join: Option<String>,
    /// Episodes to record with --join
    #[arg(long, default_value_t = 1, value_name = "N", requires = "join")]
    episodes: u64,
    /// Write what was collected as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

impl Collect {
    pub fn run(self) -> Result<ExitCode> {
        super::prepare_json(self.json.as_deref())?;
        if let Some(run) = self.out.ancestors().take(3).find(|folder| folder.join("settings.toml").is_file())
        {
            bail!(
                "--out {}: {} holds a run, whose folder is its own; choose another",
                self.out.display(),
                run.display()
            );
        }
        let stop = super::stop_on_ctrl_c()?;
        let started = Instant::now();
        let (sums, present) = match &self.join {
            Some(instance) => (self.join(instance, &stop)?, 0),
            None => self.collect(&stop)?,
        };
        let report = Report::new(sums, present, started.elapsed());
        self.json.as_deref().map_or(Ok(()), |file| super::write_json(file, &report))?;
        report.print();
        if stop.load(std::sync::atomic::Ordering::Relaxed) {
            rcwm_models::outln!("stopped; the same command goes on");
        }
        Ok(ExitCode::SUCCESS)
    }

    fn join(&self, instance: &str, stop: &std::sync::atomic::AtomicBool) -> Result<Sums> {
        let bar = bar(self.episodes, self.steps_max)?;
        let sums =
            record(instance, self.episodes, &self.out, self.seed, stop, &|progress| advance(&bar, progress))?;
        bar.finish_and_clear();
        Ok(sums)
    }

    fn collect(&self, stop: &std::sync::atomic::AtomicBool) -> Result<(Sums, u64)> {
        let tasks = self.tasks()?;
        let amounts = Amounts {
            expert: self.expert,
            mixed: self.mixed,
            random: self.random,
            pushed: self.pushed,
            masked: self.masks,
        };
        ensure!(
            amounts.total() > 0,
            "nothing to collect: give --expert, --mixed, --pushed or --random a number"
        );
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let settings = CollectSettings {
            out: self.out.clone(),
            seed: self.seed,
            simulators: self.simulators.unwrap_or(cores),
            steps_max: self.steps_max,
            disturb: self.disturb.clone(),
        };
        let plan = Plan::new(&self.out, &tasks, &amounts, self.seed, EPISODES_A_RUN);
        let bar = bar(plan.episodes(), self.steps_max)?;
        let sums = collect(&plan, &settings, stop, &|progress| advance(&bar, progress))
            .context("collecting stopped; whole episodes are kept and the same command goes on")?;
        bar.finish_and_clear();
        if let Some(look) = self.beside.as_ref().filter(|_| !stop.load(std::sync::atomic::Ordering::Relaxed))
        {
            let plan = Plan::of_disturbed(&self.out, &tasks, &amounts, self.seed, EPISODES_A_RUN)?;
            let settings = CollectSettings { disturb: look.clone(), ..settings };
            let bar = self::bar(plan.episodes(), self.steps_max)?;
            collect_disturbed(&plan, &settings, stop, &|progress| advance(&bar, progress))
                .context("collecting stopped; whole episodes are kept and the same command goes on")?;
            bar.finish_and_clear();
        }
        Ok((sums, plan.present))
    }

    fn tasks(&self) -> Result<Vec<String>> {
        let mut tasks = Vec::new();
        for name in &self.tasks {
            match name.as_str() {
                "upstream" => tasks.extend(UPSTREAM.map(str::to_owned)),
                "downstream" => tasks.extend(DOWNSTREAM.map(str::to_owned)),
                name => {
                    task_id(name)?;
                    tasks.push(name.to_owned());
                }
            }
        }
        tasks.dedup();
        Ok(tasks)
    }
}

/// Episodes of one simulator in a row: loading Meta-World takes about as long as two of them.
const EPISODES_A_RUN: u64 = 30;

pub(super) fn bar(episodes: u64, steps_max: u32) -> Result<Bar> {
    let steps = episodes.saturating_mul(u64::from(steps_max) + 1);
    let template = "{wide_bar} {pos}/{len} steps, {per_sec}, ETA {eta}, {msg} episodes";
    let bar = ProgressBar::new(steps).with_style(ProgressStyle::with_template(template)?).with_message("0");
    bar.enable_steady_tick(Duration::from_millis(200));
    Ok(Bar::new(bar, "recording", "steps"))
}

pub(super) fn advance(bar: &ProgressBar, progress: Progress) {
    match progress {
        Progress::Step => bar.inc(1),
        Progress::Episode => {
            let episodes = bar.message().parse::<u64>().unwrap_or(0) + 1;
            bar.set_message(episodes.to_string());
        }
    }
}

#[derive(Serialize)]
struct Row {
    task: String,
    policy: String,
    #[serde(flatten)]
    collected: Collected,
}

#[derive(Serialize)]
struct Report {
    rows: Vec<Row>,
    episodes: u64,
    steps: u64,
    /// Episodes that were there already.
    episodes_present: u64,
    seconds: f64,
    steps_per_s: f64,
}

impl Report {
    fn new(sums: Sums, present: u64, time: Duration) -> Self {
        let rows: Vec<_> =
            sums.into_iter().map(|((task, policy), collected)| Row { task, policy, collected }).collect();
        let steps = rows.iter().map(|row| row.collected.steps).sum();
        Self {
            episodes: rows.iter().map(|row| row.collected.episodes).sum(),
            steps,
            episodes_present: present,
            seconds: time.as_secs_f64(),
            steps_per_s: steps as f64 / time.as_secs_f64().max(1e-9),
            rows,
        }
    }

    fn print(&self) {
        rcwm_models::outln!(
            "{:24} {:>8} {:>9} {:>8} {:>8} {:>12}",
            "task",
            "policy",
            "episodes",
            "steps",
            "solved",
            "mean return"
        );
        for Row { task, policy, collected } in &self.rows {
            let Collected { episodes, steps, successes, reward_sum, .. } = collected;
            let mean = reward_sum / (*episodes).max(1) as f64;
            rcwm_models::outln!("{task:24} {policy:>8} {episodes:>9} {steps:>8} {successes:>8} {mean:>12.1}");
        }
        rcwm_models::outln!(
            "{} episodes, {} steps in {:.0} s: {:.0} a second; {} episodes were there already",
            self.episodes,
            self.steps,
            self.seconds,
            self.steps_per_s,
            self.episodes_present
        );
    }
}
