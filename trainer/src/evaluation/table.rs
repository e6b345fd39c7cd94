//! What was measured in open loop, for people.

use std::fmt::Write as _;

use super::{
    Answer, AttentionSpread, Interval, Measure, OpenLoopReport, OtherActions, Response, SeedGroup, Spread,
    TaskReport,
};

impl OpenLoopReport {
    /// The summary for people.
    #[must_use]
    pub fn table(&self) -> String {
        let name_width = self.models.iter().map(|model| model.name.len()).max().unwrap_or(0).max(5);
        let settings = &self.settings;
        let mut text = format!(
            "{} steps of context, up to {} imagined; windows: {}; pictures in [0, 1]; means, and 95% intervals over episodes\n",
            settings.context,
            settings.imagined,
            settings.windows.name()
        );
        self.errors(&mut text, name_width);
        self.kinds(&mut text, name_width);
        self.responses(&mut text, name_width);
        self.attention(&mut text, name_width);
        if self.over_seeds.groups.is_empty() {
            for comparison in &self.comparisons {
                let _ = writeln!(text, "{comparison}");
            }
        }
        self.seeds(&mut text);
        text
    }

    fn tasks(&self) -> impl Iterator<Item = (&str, &TaskReport)> {
        self.models.iter().flat_map(|model| model.tasks.iter().map(|task| (model.name.as_str(), task)))
    }

    fn errors(&self, text: &mut String, width: usize) {
        let _ = writeln!(
            text,
            "{:18} {:width$} {:>27} {:>10} {:>15} {:>15} {:>10}",
            "task", "model", "robot error x1000", "on robot", "mask IoU", "reconstruction", "reward"
        );
        let _ = writeln!(
            text,
            "{:18} {:width$} {:>27} {:>10} {:>15} {:>15} {:>10}",
            "", "", "", "x1000", "imagined/seen", "x1000", "error"
        );
        for (model, task) in self.tasks() {
            let imagined = |measure: Measure| &task.imagined[&measure];
            let error = imagined(Measure::RobotError);
            let overlap = [imagined(Measure::MaskIou), &task.posterior[&Measure::MaskIou]]
                .map(|x| number(x.mean, 1.0, 3));
            let _ = writeln!(
                text,
                "{:18} {model:width$} {:>27} {:>10} {:>15} {:>15} {:>10}",
                task.task,
                number(error.mean, 1e3, 3) + &range(error.interval, 1e3),
                number(imagined(Measure::RobotErrorOnRobot).mean, 1e3, 2),
                overlap.join("/"),
                number(imagined(Measure::ReconstructionError).mean, 1e3, 2),
                number(imagined(Measure::RewardError).mean, 1.0, 3),
            );
        }
    }

    /// The errors of robot and scene, of all windows and by kind of script.
    fn kinds(&self, text: &mut String, width: usize) {
        let _ = writeln!(
            text,
            "\n{:18} {:width$} {:8} {:>8} {:>27} {:>27} {:>22}",
            "task",
            "model",
            "script",
            "windows",
            "robot error x1000",
            "moving error x1000",
            "change (still = 1)"
        );
        for (model, task) in self.tasks() {
            let all = |measure: Measure| {
                let series = &task.imagined[&measure];
                Spread { mean: series.mean, std: series.std, interval: series.interval }
            };
            let mut row = |kind: &str, windows: usize, of: &dyn Fn(Measure) -> Spread| {
                let cell = |measure: Measure, scale: f64| {
                    let found = of(measure);
                    number(found.mean, scale, 3) + &range(found.interval, scale)
                };
                let _ = writeln!(
                    text,
                    "{:18} {model:width$} {kind:8} {windows:>8} {:>27} {:>27} {:>22}",
                    task.task,
                    cell(Measure::RobotError, 1e3),
                    cell(Measure::MovingError, 1e3),
                    cell(Measure::ChangeError, 1.0),
                );
            };
            row("all", task.trajectories, &all);
            for kind in &task.kinds {
                row(&kind.kind, kind.trajectories, &|measure| kind.imagined[&measure]);
            }
        }
    }

    fn responses(&self, text: &mut String, width: usize) {
        let found = || self.tasks().filter_map(|(model, task)| Some((model, task, task.response.as_ref()?)));
        let Some((_, _, Response { other, .. })) = found().next() else { return };
        let what = match other {
            OtherActions::Still => {
                "share of the true change that the actions make in the imagined picture (1: all, 0: none)"
            }
            OtherActions::Mirrored => {
                "root mean square of the difference, in levels of 255 (its truth is not known)"
            }
        };
        let _ = writeln!(text, "\nrecorded actions against the robot {}: {what}", other.title());
        let _ = writeln!(
            text,
            "{:18} {:width$} {:>24} {:>17} {:>12} {:>24} {:>24} {:>15}",
            "task",
            "model",
            "environment branch",
            "levels of true",
            "elsewhere",
            "robot branch",
            "whole picture",
            "on robot"
        );
        for (model, task, response) in found() {
            let answer = |answer: Answer| response.answers.get(&answer);
            let share = |of: Answer| {
                let Some(found) = answer(of) else { return "-".to_owned() };
                match found.share {
                    Some(share) => format!("{share:.3}{}", range(found.interval, 1.0)),
                    None => format!("{:.2}", found.imagined * 255.0),
                }
            };
            let levels = |of: Answer| {
                answer(of).map_or("-".to_owned(), |found| {
                    format!("{:.2} of {:.1}", found.imagined * 255.0, found.truth * 255.0)
                })
            };
            let elsewhere = answer(Answer::Elsewhere)
                .map_or("-".to_owned(), |found| format!("{:.2}", found.imagined * 255.0));
            let _ = writeln!(
                text,
                "{:18} {model:width$} {:>24} {:>17} {elsewhere:>12} {:>24} {:>24} {:>15}",
                task.task,
                share(Answer::Environment),
                levels(Answer::Environment),
                share(Answer::Robot),
                share(Answer::Picture),
                answer(Answer::PictureOnRobot).map_or("-".to_owned(), |found| number(found.share, 1.0, 3)),
            );
        }
    }

    fn attention(&self, text: &mut String, width: usize) {
        let found: Vec<_> =
            self.tasks().filter_map(|(model, task)| Some((model, task, task.attention.as_ref()?))).collect();
        if found.is_empty() {
            return;
        }
        let _ = writeln!(
            text,
            "\nattention at the imagined states; shares lie elsewhere than in the mean over queries, over states, than even attention\n\
             {:18} {:width$} {:>8} {:>18} {:>13} {:>12} {:>10}",
            "task", "model", "even", "weights", "over queries", "over states", "from even"
        );
        for (model, task, spread) in found {
            let AttentionSpread { even, smallest, largest, over_queries, over_states, from_even, .. } =
                spread;
            let _ = writeln!(
                text,
                "{:18} {model:width$} {even:>8.4} {:>18} {over_queries:>13.4} {over_states:>12.4} {from_even:>10.4}",
                task.task,
                format!("{smallest:.4} to {largest:.4}"),
            );
        }
    }

    fn seeds(&self, text: &mut String) {
        let over = &self.over_seeds;
        for note in &over.notes {
            let _ = writeln!(text, "\n{note}");
        }
        if over.groups.is_empty() {
            return;
        }
        let width = over.groups.iter().map(|group| group.label.len()).max().unwrap_or(0).max(5);
        let _ = writeln!(
            text,
            "\nover training seeds: mean +- standard deviation of the seeds' means\n{:18} {:8} {:width$} {:>6} {:>20} {:>20} {:>20}",
            "task",
            "script",
            "models",
            "seeds",
            "robot error x1000",
            "moving error x1000",
            "change (still = 1)"
        );
        for group in &over.groups {
            seed_rows(text, group, width);
        }
        for comparison in &over.comparisons {
            let _ = writeln!(text, "{comparison}");
        }
    }
}

fn seed_rows(text: &mut String, group: &SeedGroup, width: usize) {
    for rows in group.rows.chunk_by(|a, b| (&a.task, &a.kind) == (&b.task, &b.kind)) {
        let cell = |measure: Measure, scale: f64| {
            let found = rows.iter().find(|row| row.measure == measure);
            found.map_or("-".to_owned(), |row| match row.values.len() {
                1 => format!("{:.3}", row.mean * scale),
                _ => format!("{:.3} +- {:.3}", row.mean * scale, row.std * scale),
            })
        };
        let _ = writeln!(
            text,
            "{:18} {:8} {:width$} {:>6} {:>20} {:>20} {:>20}",
            rows[0].task,
            rows[0].kind.as_deref().unwrap_or("all"),
            group.label,
            group.seeds.len(),
            cell(Measure::RobotError, 1e3),
            cell(Measure::MovingError, 1e3),
            cell(Measure::ChangeError, 1.0),
        );
    }
}

fn number(value: Option<f64>, scale: f64, digits: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{:.digits$}", value * scale))
}

fn range(interval: Option<Interval>, scale: f64) -> String {
    interval.map_or_else(String::new, |i| format!(" ({:.3} to {:.3})", i.low * scale, i.high * scale))
}
