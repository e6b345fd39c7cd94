use maud::{Markup, html};

use super::plot;
use crate::plots::{Band, COLOURS, Line, Panel, Scale};
use crate::report::html::{Column, nothing, percent, percents, table, words};
use crate::report::learning::LearningCurve;
use crate::report::{Report, ReportError};

/// Success against steps of the environment (paper, Fig. 6).
pub(super) fn section(report: &Report) -> Result<Markup, ReportError> {
    if report.learning_curves.is_empty() {
        return Ok(nothing(
            "add --runs LABEL=DIR, the folder of a run of finetune or train that was evaluated while it learned \
             (--set finetune.evaluation.every_steps=N), once a seed; for example --runs \"rcwm, pre-trained=runs/a\".",
        ));
    }
    let mut plots = Vec::new();
    for task in report.learning_curves.chunk_by(|a, b| a.task == b.task) {
        plots.push(plot(&panel(task))?);
    }
    let columns = [
        Column::Words("task"),
        Column::Words("run"),
        Column::Words("seeds"),
        Column::Words("layouts"),
        Column::Number("environment steps"),
        Column::Number("success, mean of seeds"),
        Column::Number("95% interval"),
    ];
    let rows: Vec<_> = report.learning_curves.iter().map(row).collect();
    Ok(html! {
        p {
            "Separate episodes on layouts that are never learned from, every so many steps. Lines are means over seeds, bands 95% \
             bootstrap intervals over them; the table has the last point."
        }
        div.plots { @for plot in plots { (plot) } }
        (table(&columns, &rows))
    })
}

fn panel(curves: &[LearningCurve]) -> Panel {
    let line = |(index, curve): (usize, &LearningCurve)| {
        let at = |steps: u64| steps as f64;
        let edge = |point: &crate::report::learning::LearningPoint| {
            point.interval.map(|band| (at(point.environment_steps), band.low, band.high))
        };
        let edges: Vec<_> = curve.points.iter().filter_map(edge).collect();
        Line {
            label: curve.label.clone(),
            colour: COLOURS[index % COLOURS.len()],
            points: curve.points.iter().map(|point| (at(point.environment_steps), point.mean)).collect(),
            band: (!edges.is_empty()).then_some(Band { edges }),
            faint: false,
        }
    };
    Panel {
        title: curves.first().map_or_else(String::new, |curve| format!("{}: success rate", curve.task)),
        x_label: "steps of the environment".to_owned(),
        scale: Scale::Linear,
        lines: curves.iter().enumerate().map(line).collect(),
        marks: Vec::new(),
    }
}

fn row(curve: &LearningCurve) -> Vec<Option<Markup>> {
    let last = curve.points.last();
    let seeds: Vec<String> = curve.seeds.iter().map(u64::to_string).collect();
    vec![
        words(&curve.task),
        words(&curve.label),
        words(seeds.join(", ")),
        words(curve.layouts.join(", ")),
        last.and_then(|point| words(point.environment_steps.to_string())),
        last.and_then(|point| words(percent(point.mean))),
        last.and_then(|point| point.interval).and_then(|found| words(percents(found))),
    ]
}
