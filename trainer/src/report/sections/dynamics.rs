use maud::{Markup, html};

use super::{plot, seeds};
use crate::evaluation::{Measure, Series, Spread, TaskReport, Windows};
use crate::report::html::{Column, nothing, table, words};
use crate::report::page::Compared;
use crate::report::{Dynamics, Part, Report, ReportError, UNDISTURBED};

const HOW: &str =
    "add --checkpoint DIR (of RCWM and of the baseline) and --data DIR with episodes that have masks.";

/// Robot dynamics error: curves and ratios (paper, Fig. 4).
pub(super) fn robot(report: &Report) -> Result<Markup, ReportError> {
    let parts = of(report, UNDISTURBED);
    let Some(first) = parts.first() else { return Ok(nothing(HOW)) };
    let compared: Vec<_> = report.comparisons.iter().filter(|found| found.disturb == UNDISTURBED).collect();
    Ok(html! {
        p {
            "A model sees " (first.source.settings.context) " steps of a trajectory and imagines " (first.source.settings.imagined)
            " more with the recorded actions. The error is " (Measure::RobotError.definition()) ". Curves are means over trajectories, \
             bands one standard deviation. Windows: " (windows(first.source.settings.windows)) "."
        }
        (curves(&parts, Measure::RobotError)?)
        (errors(&parts))
        (seeds::section(report, UNDISTURBED))
        (ratios(&compared))
    })
}

fn windows(windows: Windows) -> &'static str {
    match windows {
        Windows::Moving => {
            "they end before the task is first solved, or where the model's steps end, and the robot moves at half of the imagined steps or more"
        }
        Windows::Anywhere => "anywhere in an episode, also where the robot holds still or after success",
    }
}

/// Error on what moves but the robot, by kind of script.
pub(super) fn scene(report: &Report) -> Result<Markup, ReportError> {
    let parts = of(report, UNDISTURBED);
    let known = |part: &&&Part<Dynamics>| part.measured.report.imagined.contains_key(&Measure::MovingError);
    let parts: Vec<_> = parts.iter().filter(known).copied().collect();
    if parts.is_empty() {
        return Ok(nothing(HOW));
    }
    Ok(html! {
        p { "The same imagined steps. Moving error: " (Measure::MovingError.definition()) "." }
        p { "Change error: " (Measure::ChangeError.definition()) "." }
        (curves(&parts, Measure::MovingError)?)
        (by_kind(&parts))
    })
}

/// Robot and scene by who decided in the episode.
fn by_kind(parts: &[&Part<Dynamics>]) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("model"),
        Column::Words("script"),
        Column::Number("windows (episodes)"),
        Column::Number("robot error × 1000"),
        Column::Number("95% interval"),
        Column::Number("moving error × 1000"),
        Column::Number("95% interval"),
        Column::Number("change error (still = 1)"),
        Column::Number("95% interval"),
    ];
    let mut rows = Vec::new();
    for part in parts {
        let report = &part.measured.report;
        let all = |measure: Measure| {
            let series = report.imagined.get(&measure)?;
            Some(Spread { mean: series.mean, std: series.std, interval: series.interval })
        };
        let mut row = |kind: &str,
                       windows: usize,
                       episodes: usize,
                       of: &dyn Fn(Measure) -> Option<Spread>| {
            let mut row = vec![
                words(&report.task),
                words(&part.source.model),
                words(kind),
                words(format!("{windows} ({episodes})")),
            ];
            for (measure, scale) in Measure::COMPARED.into_iter().zip([1e3, 1e3, 1.0]) {
                let found = of(measure);
                row.push(found.and_then(|x| x.mean).and_then(|mean| words(format!("{:.3}", mean * scale))));
                let range = found.and_then(|x| x.interval);
                row.push(range.and_then(|i| words(format!("{:.3} to {:.3}", i.low * scale, i.high * scale))));
            }
            rows.push(row);
        };
        row("all", report.trajectories, report.episodes, &all);
        for kind in &report.kinds {
            row(&kind.kind, kind.trajectories, kind.episodes, &|measure| {
                kind.imagined.get(&measure).copied()
            });
        }
    }
    html! {
        (table(&columns, &rows))
        p.soft {
            "Missing: nothing but the robot moves in these windows, or they are of one episode, over which there is no interval."
        }
    }
}

/// Reconstruction and reward error over the imagined steps (paper, Fig. 7).
pub(super) fn imagination(report: &Report) -> Result<Markup, ReportError> {
    let parts = of(report, UNDISTURBED);
    if parts.is_empty() {
        return Ok(nothing(HOW));
    }
    Ok(html! {
        p {
            "The same imagined steps. Reconstruction error: " (Measure::ReconstructionError.definition()) ". Reward error: "
            (Measure::RewardError.definition()) "."
        }
        h3 { "Reconstruction" } (curves(&parts, Measure::ReconstructionError)?)
        h3 { "Reward" } (curves(&parts, Measure::RewardError)?)
    })
}

/// Film strips with both branches and their masks (paper, Fig. 11).
pub(super) fn strips(report: &Report) -> Result<Markup, ReportError> {
    let parts = of(report, UNDISTURBED);
    if parts.iter().all(|part| part.pictures.is_empty()) {
        return Ok(nothing(HOW));
    }
    let mut figures = Vec::new();
    for part in parts {
        let is_strip = |(place, _): &(usize, _)| !part.measured.response_pictures.contains(place);
        for (_, file) in part.pictures.iter().enumerate().filter(is_strip) {
            let title = format!("{}, {}", part.source.task, part.source.model);
            figures.push(html! {
                h3 { (title) } figure { div.strip { (report.picture(file, "", &title)?) } }
            });
        }
    }
    Ok(html! {
        p {
            "Framed pictures are imagined. Each branch is shown times its mask: where the mask is 0, its picture is grey. The baseline \
             has one branch; its mask predicts the robot's."
        }
        @for figure in figures { (figure) }
    })
}

/// The models on data that were disturbed so.
pub(super) fn of<'a>(report: &'a Report, disturb: &str) -> Vec<&'a Part<Dynamics>> {
    report.dynamics.iter().filter(|part| part.source.disturb == disturb).collect()
}

/// A plot a task, a line a model.
pub(super) fn curves(parts: &[&Part<Dynamics>], measure: Measure) -> Result<Markup, ReportError> {
    let mut plots = Vec::new();
    for task in parts.chunk_by(|a, b| a.source.task == b.source.task) {
        let models: Vec<(&str, &TaskReport)> =
            task.iter().map(|part| (part.source.model.as_str(), &part.measured.report)).collect();
        plots.push(plot(&TaskReport::panel(&models, measure))?);
    }
    Ok(html! { div.plots { @for plot in plots { (plot) } } })
}

/// Means with intervals.
fn errors(parts: &[&Part<Dynamics>]) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("model"),
        Column::Number("error × 1000"),
        Column::Number("95% interval"),
        Column::Number("on the robot × 1000"),
        Column::Number("mask IoU"),
        Column::Number("trajectories (episodes)"),
    ];
    let row = |part: &&Part<Dynamics>| {
        let report = &part.measured.report;
        let series = |measure: Measure| report.imagined.get(&measure);
        vec![
            words(&report.task),
            words(&part.source.model),
            mean(series(Measure::RobotError), 1e3),
            interval(series(Measure::RobotError), 1e3),
            mean(series(Measure::RobotErrorOnRobot), 1e3),
            mean(series(Measure::MaskIou), 1.0),
            words(format!("{} ({})", report.trajectories, report.episodes)),
        ]
    };
    html! {
        (table(&columns, &parts.iter().map(row).collect::<Vec<_>>()))
        p.soft { "Means over imagined steps; intervals are bootstraps over episodes." }
    }
}

pub(super) fn mean(series: Option<&Series>, scale: f64) -> Option<Markup> {
    series.and_then(|series| series.mean).and_then(|mean| words(format!("{:.3}", mean * scale)))
}

pub(super) fn interval(series: Option<&Series>, scale: f64) -> Option<Markup> {
    let found = series.and_then(|series| series.interval)?;
    words(format!("{:.3} to {:.3}", found.low * scale, found.high * scale))
}

/// RCWM's error divided by the baseline's.
pub(super) fn ratios(compared: &[&Compared]) -> Markup {
    if compared.is_empty() {
        return html! {
            p.none { "No ratio: give one --checkpoint of RCWM and one of the baseline (--model vanilla), on the same --data." }
        };
    }
    let columns = [
        Column::Words("task"),
        Column::Words("model"),
        Column::Words("against"),
        Column::Number("ratio of mean errors"),
        Column::Number("95% interval"),
    ];
    let row = |found: &&Compared| {
        let found = &found.comparison;
        let range = found.interval.map(|i| format!("{:.3} to {:.3}", i.low, i.high));
        vec![
            words(&found.task),
            words(&found.model),
            words(&found.against),
            words(format!("{:.3}", found.ratio)),
            range.and_then(words),
        ]
    };
    let mut rows: Vec<_> = compared.iter().map(row).collect();
    let pairs = compared.iter().map(|found| (&found.comparison.model, &found.comparison.against));
    let one_pair = pairs.clone().all(|pair| Some(pair) == pairs.clone().next());
    if rows.len() > 1 && one_pair {
        let logs: f64 = compared.iter().map(|found| found.comparison.ratio.ln()).sum();
        let mean = (logs / compared.len() as f64).exp();
        let empty = || Some(html! {});
        rows.push(vec![words("geometric mean"), empty(), empty(), words(format!("{mean:.3}")), empty()]);
    }
    html! {
        (table(&columns, &rows))
        p.soft { "Below 1 RCWM is nearer to the truth. The same trajectories are drawn for both in the bootstrap." }
    }
}
