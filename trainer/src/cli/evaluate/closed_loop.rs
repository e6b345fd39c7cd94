//! `evaluate --task`: success in the simulator.

use super::*;
use rcwm_models::interface::Interface;
use rcwm_trainer::acting::check_acting;

impl Evaluate {
    pub(super) fn closed_loop(&self, stop: &AtomicBool) -> Result<()> {
        for task in &self.tasks {
            task_id(task)?;
        }
        ensure!(self.checkpoints.len() < 2, "--task takes one --checkpoint; run one after the other");
        let folder = tempfile::tempdir().context("temporary folder for the bundle")?;
        let policy = match (&self.bundle, self.checkpoints.first()) {
            (Some(_), _) if self.engine == TRAINER_ENGINE => {
                anyhow::bail!("--engine trainer runs a --checkpoint, no --bundle; give its run's checkpoint")
            }
            (Some(bundle), _) => Deployed::Bundle(std::path::absolute(bundle)?),
            (None, Some(checkpoint)) => self.deployed(checkpoint, folder.path(), stop)?,
            (None, None) => anyhow::bail!("give --checkpoint or --bundle"),
        };
        let mut reports = Vec::new();
        let all = self.tasks.iter().flat_map(|task| self.disturb.iter().map(move |disturb| (task, disturb)));
        for (task, disturb) in all {
            let bar = episodes_bar(self.episodes, self.steps_max, task)?;
            let show = |positions: &[Position]| {
                let steps = |at: &Position| at.episodes * u64::from(self.steps_max) + u64::from(at.steps);
                bar.set_position(positions.iter().map(steps).sum());
            };
            let settings = self.loop_settings(task, disturb);
            let report = match &policy {
                Deployed::Bundle(bundle) => closed_loop(bundle, &settings, stop, show),
                Deployed::Here(checkpoint) => {
                    let agent = Agent::new(&checkpoint.parameters.frozen(), &checkpoint.settings.model)?;
                    closed_loop_in_trainer(agent, &settings, stop, show)
                }
            };
            bar.finish_and_clear();
            let report = report?;
            rcwm_models::outln!("{}", describe(&report));
            reports.push(report);
        }
        let of = self.bundle.as_ref().or(self.checkpoints.first()).cloned();
        let outcome = ClosedLoopResults { of, tasks: reports };
        self.json.as_deref().map_or(Ok(()), |file| crate::cli::write_json(file, &outcome))
    }

    pub(super) fn loop_settings(&self, task: &str, disturb: &str) -> ClosedLoopSettings {
        ClosedLoopSettings {
            task: task.to_owned(),
            episodes: self.episodes,
            layouts: self.layouts.clone(),
            seed: self.seed,
            steps_max: self.steps_max,
            disturb: disturb.to_owned(),
            engine: self.engine.clone(),
            sample: self.latents == Some(LatentsName::Sample),
            simulators: self.simulators,
            simulator: self.simulator.clone(),
            runtime: self.runtime.clone(),
        }
    }

    /// Exports a checkpoint's policy into `folder`, if a runtime deploys its kind.
    pub(super) fn deployed(&self, checkpoint: &Path, folder: &Path, stop: &AtomicBool) -> Result<Deployed> {
        let checkpoint = Checkpoint::read(checkpoint, &Device::Cpu)?;
        check_acting(&checkpoint.settings.model, true)?;
        if self.engine == TRAINER_ENGINE {
            return Ok(Deployed::Here(Box::new(checkpoint)));
        }
        let place = folder.join("bundle");
        let options = Options {
            task: self.tasks.first().cloned().unwrap_or_default(),
            interface: Interface::metaworld(),
            parts: BundleKind::of(checkpoint.settings.model.kind).parts().to_vec(),
            golden_episode: None,
            golden_ticks: 1,
            golden_seed: 0,
            source_revision: env!("RCWM_SOURCE_REVISION").to_owned(),
            replace: false,
        };
        export::write(&checkpoint, &place, &options, &Stop(stop))?;
        Ok(Deployed::Bundle(place))
    }
}

/// Where a policy decides.
pub(super) enum Deployed {
    /// In a runtime.
    Bundle(PathBuf),
    /// In this process.
    Here(Box<Checkpoint>),
}

/// Ends an export on Ctrl-C.
struct Stop<'a>(&'a AtomicBool);

impl export::Progress for Stop<'_> {
    fn step(&self, _what: &str, _done: usize, _total: usize) -> Result<(), ExportError> {
        if self.0.load(Ordering::Relaxed) { Err(ExportError::Interrupted) } else { Ok(()) }
    }
}

fn episodes_bar(episodes: u64, steps_max: u32, task: &str) -> Result<Bar> {
    let template = "{msg} {wide_bar} {pos}/{len} steps, {per_sec}, ETA {eta}";
    let bar = ProgressBar::new(episodes * u64::from(steps_max))
        .with_style(ProgressStyle::with_template(template)?)
        .with_message(task.to_owned());
    bar.enable_steady_tick(Duration::from_millis(200));
    Ok(Bar::new(bar, "deciding", "steps"))
}

fn describe(report: &ClosedLoopReport) -> String {
    let ClosedLoopReport { settings, episodes, successes, interval, return_mean, return_std, .. } = report;
    let percent = |x: f64| format!("{:.0}%", 100.0 * x);
    let disturbed =
        if settings.disturb == "none" { String::new() } else { format!(", {} disturbed", settings.disturb) };
    format!(
        "{}{disturbed}: success {} ({successes} of {episodes}; 95% {} to {}), return {return_mean:.1} +- {return_std:.1}; {} steps \
         in {:.0} s",
        settings.task,
        percent(report.success_rate),
        percent(interval.low),
        percent(interval.high),
        report.steps,
        report.seconds
    )
}
