//! `evaluate --report`: measures what is missing, part by part, and draws the page.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use candle_core::Device;
use indicatif::{ProgressBar, ProgressStyle};
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::evaluation::{
    ClosedLoopSettings, EvaluationError, OpenLoopSettings, Position, Recordings, TaskTrajectories,
};
use rcwm_trainer::replay::Folder;
use rcwm_trainer::report::{
    AttentionPart, Dynamics, Learning, Policy, Provenance, Report, ReportError, Results, Store, Subject,
    Success, UNDISTURBED, policies, shown_path,
};

use super::bars::{self, Bar};

/// What goes into a report.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Report")]
pub struct ReportArguments {
    /// Folder for a page, index.html and report.json, with all that is given here; what its parts hold already is not measured again
    #[arg(long, value_name = "DIR", conflicts_with_all = ["tasks", "bundle", "out"])]
    pub report: Option<PathBuf>,
    /// Folder with a bundle a task, named after the tasks; the policy is called as the folder (repeatable)
    #[arg(long, value_name = "DIR", requires = "report")]
    bundles: Vec<PathBuf>,
    /// Recorded episodes with masks of a disturbed scene, for example textures=data/textures (repeatable)
    #[arg(long, value_name = "NAME=DIR", requires = "report", value_parser = labelled)]
    disturbed_data: Vec<(String, PathBuf)>,
    /// What evaluate --task ... --json wrote, once a seed, for example "rcwm, pre-trained=runs/a.json" (repeatable)
    #[arg(long, value_name = "LABEL=FILE", requires = "report", value_parser = labelled)]
    results: Vec<(String, PathBuf)>,
    /// Folder of a run of finetune or train that was evaluated while it learned, once a seed, for example "rcwm, pre-trained=runs/a"
    /// (repeatable)
    #[arg(long, value_name = "LABEL=DIR", requires = "report", value_parser = labelled)]
    runs: Vec<(String, PathBuf)>,
}

fn labelled(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((label, path)) if !label.trim().is_empty() && !path.is_empty() => {
            Ok((label.trim().to_owned(), PathBuf::from(path)))
        }
        _ => Err("expected a name, = and a path".to_owned()),
    }
}

/// What the other arguments say.
pub struct Inputs<'a> {
    pub arguments: &'a ReportArguments,
    pub checkpoints: Vec<(String, Checkpoint)>,
    pub data: Option<&'a Path>,
    pub masks: Option<&'a Path>,
    pub open_loop: OpenLoopSettings,
    /// With task and disturbance to be filled in.
    pub closed_loop: ClosedLoopSettings,
    pub disturb: &'a [String],
    pub device: Device,
    /// As on the command line.
    pub device_name: &'a str,
    pub json: Option<&'a Path>,
}

impl Inputs<'_> {
    /// Measures what is missing and draws the page, also after Ctrl-C.
    pub fn run(self, folder: &Path, stop: &AtomicBool) -> Result<()> {
        let data = self.data.is_some() || !self.arguments.disturbed_data.is_empty();
        ensure!(data || self.checkpoints.is_empty(), "--checkpoint: add --data, episodes to measure it on");
        ensure!(!data || !self.checkpoints.is_empty(), "--data: add --checkpoint, a model to measure on it");
        let store = Store::open(folder)?;
        let mut work = Work { inputs: &self, store: &store, stop, measured: 0, found: 0 };
        let outcome = work.measure();
        let (measured, found) = (work.measured, work.found);
        if let Err(error) = &outcome
            && !error.downcast_ref().is_some_and(ReportError::is_interrupted)
        {
            return outcome;
        }
        let report = Report::read(&store, Provenance::now(self.device_name), command())?;
        report.write(folder)?;
        if let Some(json) = self.json {
            super::write_json(json, &report)?;
        }
        let page = folder.join("index.html");
        match measured + found {
            0 => rcwm_models::outln!("drawn anew: {}", page.display()),
            _ => rcwm_models::outln!(
                "{measured} parts measured, {found} were there; the page is {}",
                page.display()
            ),
        }
        ensure!(outcome.is_ok(), "interrupted; what was measured is kept, the same command goes on");
        Ok(())
    }
}

struct Work<'a> {
    inputs: &'a Inputs<'a>,
    store: &'a Store,
    stop: &'a AtomicBool,
    measured: usize,
    found: usize,
}

/// Episodes of one task.
struct TaskData {
    disturb: String,
    task: String,
    folder: Folder,
    sha256: String,
}

impl Work<'_> {
    fn measure(&mut self) -> Result<()> {
        self.results()?;
        self.learning()?;
        // The fast ones first.
        self.models()?;
        self.policies()
    }

    fn made(&self) -> Provenance {
        Provenance::now(self.inputs.device_name)
    }

    fn results(&mut self) -> Result<()> {
        if self.inputs.arguments.results.is_empty() {
            return Ok(());
        }
        let (source, results) = Results::read(&self.inputs.arguments.results)?;
        let draft = self.store.draft::<Results>(&source)?;
        Ok(self.store.keep(draft, source, results, self.made(), 0.0)?)
    }

    fn learning(&mut self) -> Result<()> {
        if self.inputs.arguments.runs.is_empty() {
            return Ok(());
        }
        let (source, learning) = Learning::read(&self.inputs.arguments.runs)?;
        let draft = self.store.draft::<Learning>(&source)?;
        Ok(self.store.keep(draft, source, learning, self.made(), 0.0)?)
    }

    fn policies(&mut self) -> Result<()> {
        if self.inputs.arguments.bundles.is_empty() {
            return Ok(());
        }
        let (policies, left_out) = policies(&self.inputs.arguments.bundles)?;
        for reason in left_out {
            rcwm_models::outln!("left out: {reason}");
        }
        let mut jobs = Vec::new();
        for disturb in disturbances(self.inputs.disturb) {
            for policy in &policies {
                let (task, disturb) = (policy.task.clone(), disturb.to_owned());
                let settings = ClosedLoopSettings { task, disturb, ..self.inputs.closed_loop.clone() };
                match self.store.find::<Success>(&policy.source(&settings)) {
                    Some(_) => self.found += 1,
                    None => jobs.push((policy, settings)),
                }
            }
        }
        let steps = |settings: &ClosedLoopSettings| settings.episodes * u64::from(settings.steps_max);
        let bar = bar(jobs.iter().map(|(_, settings)| steps(settings)).sum(), "steps")?;
        for (policy, settings) in jobs {
            self.policy(policy, settings, &bar)?;
        }
        bar.finish_and_clear();
        Ok(())
    }

    fn policy(&mut self, policy: &Policy, settings: ClosedLoopSettings, bar: &ProgressBar) -> Result<()> {
        let (begin, before) = (Instant::now(), bar.position());
        bar.set_message(format!("{} on {}, disturbance {}", policy.name, policy.task, settings.disturb));
        let at = |position: &Position| {
            position.episodes * u64::from(settings.steps_max) + u64::from(position.steps)
        };
        let source = policy.source(&settings);
        let mut draft = self.store.draft::<Success>(&source)?;
        let seen = |positions: &[Position]| bar.set_position(before + positions.iter().map(at).sum::<u64>());
        let found = policy.measure(&settings, &mut draft, self.stop, seen)?;
        bar.set_position(before + settings.episodes * u64::from(settings.steps_max));
        let (successes, episodes) = (found.successes, found.episodes);
        bar.suspend(|| {
            let disturb = &settings.disturb;
            rcwm_models::outln!(
                "{} on {}, disturbance {disturb}: {successes} of {episodes}",
                policy.name,
                policy.task
            );
        });
        self.store.keep(draft, source, found, self.made(), begin.elapsed().as_secs_f64())?;
        self.measured += 1;
        Ok(())
    }

    fn models(&mut self) -> Result<()> {
        if self.inputs.checkpoints.is_empty() {
            return Ok(());
        }
        let subjects =
            self.inputs.checkpoints.iter().map(|(name, checkpoint)| Subject::new(name, checkpoint));
        let subjects = subjects.collect::<Result<Vec<_>, _>>()?;
        let data = self.data()?;
        let settings = &self.inputs.open_loop;
        let missing = |data: &TaskData, subject: &Subject| {
            let source = subject.source(&data.task, &data.disturb, &data.sha256, settings);
            self.store.find::<Dynamics>(&source).is_none()
        };
        let pairs = data.iter().flat_map(|data| subjects.iter().map(move |subject| (data, subject)));
        let to_do = pairs.filter(|(data, subject)| missing(data, subject)).count();
        let bar = bar((to_do * settings.trajectories) as u64, "trajectories")?;
        for data in &data {
            self.task(data, &subjects, &bar)?;
        }
        bar.finish_and_clear();
        Ok(())
    }

    /// The tasks of all folders of data.
    fn data(&self) -> Result<Vec<TaskData>> {
        let undisturbed = self.inputs.data.map(|data| (UNDISTURBED, data, self.inputs.masks));
        let disturbed = self
            .inputs
            .arguments
            .disturbed_data
            .iter()
            .map(|(name, data)| (name.as_str(), data.as_path(), None));
        let mut found = Vec::new();
        for (disturb, path, masks) in undisturbed.into_iter().chain(disturbed) {
            let listed = Folder::list(path, masks)?;
            bars::tell(&listed.notes());
            for (task, folder) in listed.by_task() {
                let sha256 = folder.sha256()?;
                found.push(TaskData { disturb: disturb.to_owned(), task, folder, sha256 });
            }
        }
        Ok(found)
    }

    /// What is missing of one task.
    fn task(&mut self, data: &TaskData, subjects: &[Subject], bar: &ProgressBar) -> Result<()> {
        let mut recordings = None;
        for subject in subjects {
            self.dynamics(data, subject, &mut recordings, bar)?;
        }
        if data.disturb == UNDISTURBED {
            for subject in subjects.iter().filter(|subject| subject.has_attention()) {
                self.attention(data, subject, &mut recordings)?;
            }
        }
        Ok(())
    }

    fn dynamics(
        &mut self,
        data: &TaskData,
        subject: &Subject,
        recordings: &mut Option<Recordings>,
        bar: &ProgressBar,
    ) -> Result<()> {
        let (settings, device) = (self.inputs.open_loop, &self.inputs.device);
        let source = subject.source(&data.task, &data.disturb, &data.sha256, &settings);
        if self.store.find::<Dynamics>(&source).is_some() {
            self.found += 1;
            return Ok(());
        }
        let Some(recordings) = self.loaded(recordings, data)? else { return Ok(()) };
        bar.set_message(format!("{} on {}, disturbance {}", subject.name, data.task, data.disturb));
        let begin = Instant::now();
        let chosen = TaskTrajectories::choose(recordings, &settings)?;
        // Folders are of one task each.
        let Some(task) = chosen.first() else { return Ok(()) };
        let mut draft = self.store.draft::<Dynamics>(&source)?;
        let before = bar.position();
        let found =
            subject.measure(task, &settings, device, &mut draft, self.stop, |rows| bar.inc(rows as u64))?;
        bar.set_position(before + settings.trajectories as u64);
        self.store.keep(draft, source, found, self.made(), begin.elapsed().as_secs_f64())?;
        self.measured += 1;
        Ok(())
    }

    fn attention(
        &mut self,
        data: &TaskData,
        subject: &Subject,
        recordings: &mut Option<Recordings>,
    ) -> Result<()> {
        let source = subject.attention_source(&data.task, &data.sha256, &self.inputs.open_loop);
        if self.store.find::<AttentionPart>(&source).is_some() {
            self.found += 1;
            return Ok(());
        }
        if self.stop.load(Ordering::Relaxed) {
            return Err(ReportError::from(EvaluationError::Interrupted).into());
        }
        let Some(recordings) = self.loaded(recordings, data)? else { return Ok(()) };
        let begin = Instant::now();
        let mut draft = self.store.draft::<AttentionPart>(&source)?;
        if let Some(part) = subject.attend(recordings, &source, &self.inputs.device, &mut draft)? {
            self.store.keep(draft, source, part, self.made(), begin.elapsed().as_secs_f64())?;
            self.measured += 1;
        }
        Ok(())
    }

    /// The task's episodes with masks, read once; none where there are none.
    fn loaded<'r>(
        &self,
        recordings: &'r mut Option<Recordings>,
        data: &TaskData,
    ) -> Result<Option<&'r Recordings>> {
        if recordings.is_none() {
            let bar = ProgressBar::new(data.folder.len() as u64)
                .with_style(ProgressStyle::with_template("loading {msg} {wide_bar} {pos}/{len} episodes")?)
                .with_message(data.task.clone());
            let bar = Bar::new(bar, "loading", "episodes");
            let read = Recordings::load(&data.folder, &[], || bar.inc(1));
            bar.finish_and_clear();
            *recordings = Some(read?);
        }
        let found = recordings.as_ref().filter(|recordings| !recordings.is_empty());
        if found.is_none() {
            rcwm_models::outln!(
                "{}, disturbance {}: no episode has masks, not measured",
                data.task,
                data.disturb
            );
        }
        Ok(found)
    }
}

/// No disturbance first, then the others, each once.
fn disturbances(given: &[String]) -> Vec<&str> {
    let mut all = vec![UNDISTURBED];
    for disturb in given {
        if !all.contains(&disturb.as_str()) {
            all.push(disturb);
        }
    }
    all
}

/// This program's command line, without what only this machine knows.
fn command() -> String {
    let plain = |word: &str| match word.split_once('=') {
        Some((name, path)) => format!("{name}={}", shown_path(path)),
        None => shown_path(word),
    };
    let quoted = |word: String| if word.contains(char::is_whitespace) { format!("\"{word}\"") } else { word };
    let words = std::env::args_os().skip(1).map(|word| quoted(plain(&word.to_string_lossy())));
    std::iter::once("rcwm-trainer".to_owned()).chain(words).collect::<Vec<_>>().join(" ")
}

fn bar(all: u64, unit: &'static str) -> Result<Bar> {
    let template = format!("{{msg}} {{wide_bar}} {{pos}}/{{len}} {unit}, ETA {{eta}}");
    let bar = ProgressBar::new(all).with_style(ProgressStyle::with_template(&template)?);
    bar.enable_steady_tick(Duration::from_millis(200));
    Ok(Bar::new(bar, "measuring", unit))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_may_hold_commas_and_spaces_and_a_path_equals_signs() {
        let found = labelled("rcwm, pre-trained=runs/a=b.json").unwrap();
        assert_eq!(found, ("rcwm, pre-trained".to_owned(), PathBuf::from("runs/a=b.json")));
        for wrong in ["a.json", "=a.json", "label=", " =x"] {
            assert!(labelled(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn undisturbed_comes_first_and_once() {
        let given = ["textures", "none", "textures", "noise"].map(String::from);
        assert_eq!(disturbances(&given), ["none", "textures", "noise"]);
    }
}
