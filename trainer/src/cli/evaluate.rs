mod closed_loop;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use candle_core::Device;
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_models::bundle::BundleKind;
use rcwm_models::tasks::task_id;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::evaluation::{
    AttentionFilm, ClosedLoopReport, ClosedLoopResults, ClosedLoopSettings, Comparison, EvaluationError,
    Latents, Measure, Measured, ModelReport, OpenLoopReport, OpenLoopSettings, OtherActions, OverSeeds,
    Position, Recordings, TRAINER_ENGINE, TaskReport, TaskTrajectories, Trained, Windows, closed_loop,
    closed_loop_in_trainer, measure,
};
use rcwm_trainer::export::{self, ExportError, Options};
use rcwm_trainer::model::agent::Agent;
use rcwm_trainer::plots;
use rcwm_trainer::replay::Folder;
use rcwm_trainer::report::shown_path;
use rcwm_trainer::simulators::{DISTURBANCES, LAYOUTS};

use super::bars::{self, Bar};
use super::report::{Inputs, ReportArguments};

/// Steps from one picture of a strip to the next.
const STRIP_EVERY: usize = 4;

/// Judge models: robot dynamics on recorded episodes, or success in the simulator
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer evaluate --checkpoint runs/small/checkpoints/best --checkpoint \\
      runs/vanilla/checkpoints/best --data data/unseen --out runs/dynamics --json \\
      runs/dynamics/report.json
  rcwm-trainer evaluate --checkpoint runs/hammer/checkpoints/best --task hammer --episodes 20
  rcwm-trainer evaluate --bundle bundles/hammer --task hammer --episodes 20 --disturb textures \\
      --simulators 2
  rcwm-trainer evaluate --report report --bundles models/bundles --episodes 50 --checkpoint \\
      runs/small/checkpoints/last --checkpoint runs/vanilla/checkpoints/last --data data/unseen
  rcwm-trainer evaluate --report report        (draws the page anew)

With --data (paper, Fig. 4 and 7): every model sees some steps of the same trajectories and
imagines the rest with the recorded actions. The robot dynamics error is the squared error between
imagined and true picture, both multiplied by the true robot mask, mean over the whole picture;
the episodes need masks. Beside it stands the error on the pixels outside the robot that move, and
what other actions from the same start change in the imagined pictures. Windows end before the task
is solved and the robot moves in them (--windows anywhere takes all). Checkpoints that differ in
their training seed only are taken together: then intervals are over seeds. With --task: the policy is exported and deployed by rcwm-runtime in
rcwm-simulator, in lock-step; with --engine trainer it decides in this process.
With --report: both, as one page that shows all that lies in the folder's parts; a part is measured
again only if it is asked for from something else. Ctrl-C keeps what is done.")]
#[command(group = clap::ArgGroup::new("recorded").multiple(true).args(["data", "report"]))]
#[command(group = clap::ArgGroup::new("deployed").multiple(true).args(["tasks", "report"]))]
#[command(group = clap::ArgGroup::new("on").required(true).multiple(true).args(["data", "tasks", "report"]))]
pub struct Evaluate {
    /// Folder of a checkpoint (repeatable with --data: the later ones are compared with the first)
    #[arg(long = "checkpoint", value_name = "DIR", required_unless_present_any = ["bundle", "report"])]
    checkpoints: Vec<PathBuf>,
    /// Folder of recorded episodes with masks, one sub-folder a task
    #[arg(long, value_name = "DIR", conflicts_with = "tasks")]
    data: Option<PathBuf>,
    /// Folder of masks as pictures, task/episode/*.png, in place of the episodes' own
    #[arg(long, value_name = "DIR", requires = "data")]
    masks: Option<PathBuf>,
    /// Trajectories a task
    #[arg(long, default_value_t = 100, value_name = "N", requires = "recorded")]
    trajectories: usize,
    /// Steps that are seen
    #[arg(long, default_value_t = 10, value_name = "N", requires = "recorded")]
    context: usize,
    /// Steps that are imagined after them
    #[arg(long, default_value_t = 54, value_name = "N", requires = "recorded")]
    imagined: usize,
    /// Which windows of the episodes: those that end before the task is solved and in which the robot moves, or all
    #[arg(long, value_enum, default_value = "moving", requires = "recorded")]
    windows: WindowsName,
    /// What the recorded actions are compared with, from the same start
    #[arg(long, value_enum, default_value = "still", requires = "recorded")]
    other_actions: OtherActionsName,
    /// Take the most probable latents and actions, or draw them [default: sample with --data, mode with --task]
    #[arg(long, value_enum)]
    latents: Option<LatentsName>,
    /// Films a task and model, written to --out, or strips in a report [default: 2, in a report 1]
    #[arg(long, value_name = "N", requires = "recorded")]
    films: Option<usize>,
    /// Folder for plots and films
    #[arg(long, value_name = "DIR", requires = "data")]
    out: Option<PathBuf>,
    /// Task to solve in the simulator (repeatable)
    #[arg(long = "task", value_name = "TASK")]
    tasks: Vec<String>,
    /// An exported policy in place of a checkpoint
    #[arg(long, value_name = "DIR", conflicts_with_all = ["checkpoints", "data"])]
    bundle: Option<PathBuf>,
    /// Episodes of each task
    #[arg(long, default_value_t = 20, value_name = "N", requires = "deployed", value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Decisions in an episode
    #[arg(long, default_value_t = 250, value_name = "N", requires = "deployed", value_parser = clap::value_parser!(u32).range(1..=250))]
    steps_max: u32,
    /// Visual disturbance (repeatable; a report always has none too)
    #[arg(long, default_value = "none", requires = "deployed", value_parser = DISTURBANCES)]
    disturb: Vec<String>,
    /// The runtime's engine, or the trainer itself in a runtime's place
    #[arg(long, default_value = "tract", requires = "deployed", value_parser = ["tract", "ort", TRAINER_ENGINE])]
    engine: String,
    /// Simulators at a time, each with a runtime
    #[arg(long, default_value_t = 1, value_name = "N", requires = "deployed", value_parser = clap::value_parser!(u64).range(1..=256))]
    simulators: u64,
    /// Path of rcwm-simulator, where it is not beside this program
    #[arg(long, value_name = "FILE", requires = "deployed")]
    simulator: Option<PathBuf>,
    /// Path of rcwm-runtime, where it is not beside this program
    #[arg(long, value_name = "FILE", requires = "deployed")]
    runtime: Option<PathBuf>,
    /// Trajectories, draws and layouts depend on this
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Which layouts to score on. No two sets share one; settings are chosen on `choosing`, what is told is from `reporting`
    #[arg(long, default_value = "reporting", requires = "deployed", value_parser = LAYOUTS)]
    layouts: String,
    /// Where to compute with --data: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu", requires = "recorded")]
    device: String,
    /// Write what was measured as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    report: ReportArguments,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum LatentsName {
    /// Drawn, by --seed.
    Sample,
    /// The most probable ones.
    Mode,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum WindowsName {
    /// They end before success, and the robot moves at half of the imagined steps or more; at least 15 imagined steps.
    Moving,
    /// Also those in which the robot holds still or that go on after success.
    Anywhere,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum OtherActionsName {
    /// The robot holds still.
    Still,
    /// The recorded motion the other way.
    Mirrored,
}

impl Evaluate {
    pub fn run(self) -> Result<ExitCode> {
        super::prepare_json(self.json.as_deref())?;
        let stop = super::stop_on_ctrl_c()?;
        match (&self.report.report, &self.data) {
            (Some(folder), _) => self.report(folder, &stop)?,
            (None, Some(data)) => self.open_loop(data, &stop)?,
            (None, None) => self.closed_loop(&stop)?,
        }
        Ok(ExitCode::SUCCESS)
    }

    fn report(&self, folder: &Path, stop: &AtomicBool) -> Result<()> {
        ensure!(
            self.engine != TRAINER_ENGINE,
            "--engine trainer: a report deploys bundles, expected tract or ort"
        );
        let device = super::parse_device(&self.device)?;
        let mut checkpoints: Vec<(String, Checkpoint)> = Vec::new();
        for (name, _, checkpoint) in self.models(&device)? {
            let name = shown_path(&name);
            let known = checkpoints.iter().any(|(other, _)| *other == name);
            ensure!(!known, "--checkpoint: there are two models {name:?}; rename one of their folders");
            checkpoints.push((name, checkpoint));
        }
        let inputs = Inputs {
            arguments: &self.report,
            checkpoints,
            data: self.data.as_deref(),
            masks: self.masks.as_deref(),
            open_loop: self.open_loop_settings(self.films.unwrap_or(1))?,
            closed_loop: self.loop_settings("", "none"),
            disturb: &self.disturb,
            device,
            device_name: &self.device,
            json: self.json.as_deref(),
        };
        inputs.run(folder, stop)
    }

    fn open_loop_settings(&self, films: usize) -> Result<OpenLoopSettings> {
        let latents = match self.latents {
            Some(LatentsName::Mode) => Latents::Mode,
            _ => Latents::Sample,
        };
        let (trajectories, context, imagined) = (self.trajectories, self.context, self.imagined);
        ensure!(context > 0 && imagined > 0, "--context and --imagined: expected at least 1");
        ensure!(trajectories > 0, "--trajectories: expected at least 1");
        let windows = match self.windows {
            WindowsName::Moving => Windows::Moving,
            WindowsName::Anywhere => Windows::Anywhere,
        };
        let other_actions = Some(match self.other_actions {
            OtherActionsName::Still => OtherActions::Still,
            OtherActionsName::Mirrored => OtherActions::Mirrored,
        });
        let seed = self.seed;
        Ok(OpenLoopSettings { trajectories, context, imagined, latents, seed, films, windows, other_actions })
    }

    fn open_loop(&self, data: &Path, stop: &AtomicBool) -> Result<()> {
        let films = if self.out.is_some() { self.films.unwrap_or(2) } else { 0 };
        let settings = self.open_loop_settings(films)?;
        let device = super::parse_device(&self.device)?;
        let models = self.models(&device)?;
        let tasks = self.trajectories(data, &settings, &models)?;
        let report = self.measure(&models, &tasks, &settings, &device, stop)?;
        self.json.as_deref().map_or(Ok(()), |file| super::write_json(file, &report))?;
        rcwm_models::out!("{}", report.table());
        if let Some(out) = &self.out {
            for measure in Measure::ALL {
                plots::write_png(&report.plot(measure)?, &out.join(format!("{}.png", measure.name())))?;
            }
            rcwm_models::outln!("plots and films in {}", out.display());
        }
        Ok(())
    }

    /// The checkpoints by name: what kind of model they are, or where they lie if there are several of a kind.
    fn models(&self, device: &Device) -> Result<Vec<(String, PathBuf, Checkpoint)>> {
        let mut models = Vec::new();
        for path in &self.checkpoints {
            let checkpoint = Checkpoint::read(path, device)?;
            let kind = format!("{:?}", checkpoint.settings.model.kind).to_lowercase();
            models.push((kind, path.clone(), checkpoint));
        }
        let kinds: Vec<String> = models.iter().map(|(kind, ..)| kind.clone()).collect();
        for (name, path, _) in &mut models {
            if kinds.iter().filter(|kind| *kind == name).count() > 1 {
                *name = path.display().to_string().trim_end_matches("/").replace("/checkpoints/", "/");
            }
        }
        Ok(models)
    }

    fn trajectories(
        &self,
        data: &Path,
        settings: &OpenLoopSettings,
        models: &[(String, PathBuf, Checkpoint)],
    ) -> Result<Vec<TaskTrajectories>> {
        let folder = Folder::list(data, self.masks.as_deref())?;
        bars::tell(&folder.notes());
        let bar = ProgressBar::new(folder.len() as u64)
            .with_style(ProgressStyle::with_template("loading {wide_bar} {pos}/{len} episodes")?);
        let bar = Bar::new(bar, "loading", "episodes");
        let models: Vec<_> = models.iter().map(|(.., checkpoint)| &checkpoint.settings.model).collect();
        let recordings = Recordings::load(&folder, &models, || bar.inc(1))?;
        bar.finish_and_clear();
        let tasks = TaskTrajectories::choose(&recordings, settings)?;
        for task in &tasks {
            rcwm_models::outln!("{}", task.summary(settings.context));
        }
        Ok(tasks)
    }

    fn measure(
        &self,
        models: &[(String, PathBuf, Checkpoint)],
        tasks: &[TaskTrajectories],
        settings: &OpenLoopSettings,
        device: &Device,
        stop: &AtomicBool,
    ) -> Result<OpenLoopReport> {
        let total: usize = tasks.iter().map(|task| task.chosen.len() * models.len()).sum();
        let template = "{wide_bar} {pos}/{len} trajectories, ETA {eta}, {msg}";
        let bar = ProgressBar::new(total as u64).with_style(ProgressStyle::with_template(template)?);
        let bar = Bar::new(bar, "imagining", "trajectories");
        let mut report = OpenLoopReport::new(*settings);
        let mut first: Vec<Measured> = Vec::new();
        for (name, path, checkpoint) in models {
            let agent = Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model)?;
            let mut reports = Vec::new();
            for (index, task) in tasks.iter().enumerate() {
                bar.set_message(format!("{name} on {}", task.task));
                let measured = measure(&agent, task, settings, device, stop, |rows| bar.inc(rows as u64))?;
                let attention = || {
                    AttentionFilm::of(&agent, task, settings.context, settings.latents, settings.seed, device)
                };
                self.write_films(name, &task.task, &measured, attention)?;
                reports.push(TaskReport::of(task, &measured, settings));
                match (first.get(index), &report.models.first()) {
                    (Some(other), Some(against)) => report.comparisons.extend(Comparison::of(
                        task,
                        (name, &measured),
                        (&against.name, other),
                        settings.seed,
                    )),
                    _ => first.push(Measured { films: Vec::new(), response_films: Vec::new(), ..measured }),
                }
            }
            let settings = &checkpoint.settings;
            report.models.push(ModelReport {
                name: name.clone(),
                checkpoint: path.display().to_string(),
                kind: settings.model.kind,
                preset: settings.preset.clone(),
                seed: settings.seed,
                updates: settings.updates,
                tasks: reports,
            });
        }
        let trained = models.iter().zip(&report.models).map(|((name, _, checkpoint), report)| Trained {
            name,
            settings: &checkpoint.settings,
            tasks: &report.tasks,
        });
        report.over_seeds = OverSeeds::of(&trained.collect::<Vec<_>>(), settings.seed);
        bar.finish_and_clear();
        Ok(report)
    }

    /// Films of what was measured, and the first trajectory's attention, which `attention` makes.
    fn write_films(
        &self,
        model: &str,
        task: &str,
        measured: &Measured,
        attention: impl Fn() -> Result<Option<AttentionFilm>, EvaluationError>,
    ) -> Result<()> {
        let Some(out) = &self.out else { return Ok(()) };
        let films = out.join("films");
        std::fs::create_dir_all(&films).with_context(|| format!("--out {}", films.display()))?;
        for (number, film) in measured.films.iter().enumerate() {
            let stem = format!("{}-{task}-{number}", model.replace('/', "-"));
            film.write_strip(STRIP_EVERY, &films.join(format!("{stem}.png")))?;
            film.write_gif(&films.join(format!("{stem}.gif")))?;
        }
        for (number, film) in measured.response_films.iter().enumerate() {
            let stem = format!("{}-{task}-{number}-response", model.replace('/', "-"));
            film.write_strip(STRIP_EVERY, &films.join(format!("{stem}.png")))?;
            film.write_gif(&films.join(format!("{stem}.gif")))?;
        }
        if !measured.films.is_empty()
            && let Some(film) = attention()?
        {
            film.write_strip(
                STRIP_EVERY,
                &films.join(format!("{}-{task}-attention.png", model.replace('/', "-"))),
            )?;
        }
        Ok(())
    }
}
