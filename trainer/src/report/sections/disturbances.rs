use maud::{Markup, html};

use super::dynamics::{curves, interval, mean, ratios};
use super::success::{film_of, rate};
use crate::evaluation::Measure;
use crate::report::html::{Column, table, words};
use crate::report::{Dynamics, Part, Report, ReportError, Success, UNDISTURBED};

/// Success and robot dynamics error with another look of the scene (paper, Fig. 8).
pub(super) fn section(report: &Report) -> Result<Markup, ReportError> {
    Ok(html! {
        h3 { "Success" }
        (success(report)?)
        h3 { "Robot dynamics" }
        (dynamics(report)?)
    })
}

/// The disturbances that were measured, without none.
fn kinds<'a>(of: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut kinds: Vec<&str> = of.filter(|disturb| *disturb != UNDISTURBED).collect();
    kinds.sort_unstable();
    kinds.dedup();
    kinds
}

fn success(report: &Report) -> Result<Markup, ReportError> {
    let kinds = kinds(report.success.iter().map(|part| part.source.disturb.as_str()));
    if kinds.is_empty() {
        return Ok(html! {
            p.none { "Not measured: add --disturb textures, --disturb noise (with --bundles)." }
        });
    }
    let find = |like: &Part<Success>, disturb: &str| {
        let same = |part: &&Part<Success>| {
            let (a, b) = (&part.source, &like.source);
            (&a.policy, &a.task, a.disturb.as_str()) == (&b.policy, &b.task, disturb)
        };
        report.success.iter().find(same)
    };
    let mut columns = vec![Column::Words("task"), Column::Words("policy"), Column::Words(UNDISTURBED)];
    columns.extend(kinds.iter().map(|kind| Column::Words(kind)));
    let mut rows = Vec::new();
    let mut films = Vec::new();
    for part in report.success.iter().filter(|part| part.source.disturb == UNDISTURBED) {
        let disturbed: Vec<_> = kinds.iter().map(|kind| find(part, kind)).collect();
        if disturbed.iter().all(Option::is_none) {
            continue;
        }
        let mut row = vec![words(&part.source.task), words(&part.source.policy), Some(rate(&part.measured))];
        row.extend(disturbed.iter().map(|found| found.map(|part| rate(&part.measured))));
        rows.push(row);
        for part in disturbed.into_iter().flatten() {
            films.push(html! { (film_of(report, part)?) });
        }
    }
    Ok(html! {
        p { "The same layouts; the textures of objects, table and background are changed, or the background is noise." }
        (table(&columns, &rows))
        div.films { @for film in films { (film) } }
    })
}

fn dynamics(report: &Report) -> Result<Markup, ReportError> {
    let kinds = kinds(report.dynamics.iter().map(|part| part.source.disturb.as_str()));
    if kinds.is_empty() {
        return Ok(html! {
            p.none {
                "Not measured: add --disturbed-data NAME=DIR with episodes that were collected so (rcwm-trainer collect --disturb \
                 textures --masks ...), beside --checkpoint and --data."
            }
        });
    }
    let columns = [
        Column::Words("task"),
        Column::Words("model"),
        Column::Words("disturbance"),
        Column::Number("error × 1000"),
        Column::Number("95% interval"),
        Column::Number("times that without"),
    ];
    let disturbed = report.dynamics.iter().filter(|part| part.source.disturb != UNDISTURBED);
    let tasks: Vec<&str> = disturbed.map(|part| part.source.task.as_str()).collect();
    let shown = report.dynamics.iter().filter(|part| tasks.contains(&part.source.task.as_str()));
    let mut shown: Vec<_> = shown.collect();
    shown.sort_by_key(|part| (&part.source.task, &part.source.model, part.source.disturb != UNDISTURBED));
    let rows: Vec<_> = shown.into_iter().map(|part| row(report, part)).collect();
    let mut plots = Vec::new();
    for kind in &kinds {
        let compared: Vec<_> = report.comparisons.iter().filter(|found| found.disturb == *kind).collect();
        let curves = curves(&super::dynamics::of(report, kind), Measure::RobotError)?;
        plots.push(html! { h3 { "Robot dynamics: " (kind) } (curves) (ratios(&compared)) });
    }
    Ok(html! {
        (table(&columns, &rows))
        p.soft { "Other trajectories, unless they were collected with the same seed." }
        @for plot in plots { (plot) }
    })
}

fn row(report: &Report, part: &Part<Dynamics>) -> Vec<Option<Markup>> {
    let error = |part: &Part<Dynamics>| part.measured.report.imagined.get(&Measure::RobotError)?.mean;
    let without = report.dynamics.iter().find(|other| {
        let (a, b) = (&other.source, &part.source);
        (&a.task, &a.model, &a.weights_sha256, a.disturb.as_str())
            == (&b.task, &b.model, &b.weights_sha256, UNDISTURBED)
    });
    let times =
        without.and_then(|without| Some(error(part)? / error(without)?)).filter(|times| times.is_finite());
    let series = part.measured.report.imagined.get(&Measure::RobotError);
    vec![
        words(&part.source.task),
        words(&part.source.model),
        words(&part.source.disturb),
        mean(series, 1e3),
        interval(series, 1e3),
        times.and_then(|times| words(format!("{times:.2}"))),
    ]
}
