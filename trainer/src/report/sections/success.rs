use maud::{Markup, html};
use rcwm_models::tasks::{DOWNSTREAM, UPSTREAM};

use super::results::{compared, pooled};
use crate::report::html::{Column, number, percent, percents, range, table, words};
use crate::report::{Part, Report, ReportError, Success, UNDISTURBED};

const COLUMNS: [Column<'_>; 7] = [
    Column::Words("task"),
    Column::Words("policy"),
    Column::Words("success"),
    Column::Words("95% interval"),
    Column::Number("return"),
    Column::Number("steps"),
    Column::Number("tick p50 / p99, ms"),
];

/// Every task of the paper with its policies.
pub(super) fn section(report: &Report) -> Result<Markup, ReportError> {
    let parts: Vec<_> = report.success.iter().filter(|part| part.source.disturb == UNDISTURBED).collect();
    let others = parts.iter().map(|part| part.source.task.as_str());
    let mut others: Vec<&str> =
        others.filter(|task| !UPSTREAM.contains(task) && !DOWNSTREAM.contains(task)).collect();
    others.dedup();
    Ok(html! {
        p {
            "Closed loop in the simulator, in lock-step: the exported policy is deployed by rcwm-runtime. An episode counts as solved \
             if the task was solved at any step. Intervals are Wilson's. A step is one decision, which is two steps of the \
             environment. The tick is the runtime's time from image to action, of the slowest runtime, on a machine that also simulates."
        }
        @if parts.is_empty() {
            p.none { "No policy was given: add " code { "--bundles DIR" } "." }
        }
        h3 { "Downstream tasks" }
        (tasks(&parts, &DOWNSTREAM))
        h3 { "Upstream tasks" }
        (tasks(&parts, &UPSTREAM))
        @if !others.is_empty() { h3 { "Other tasks" } (tasks(&parts, &others)) }
        @if !report.policies_over_seeds.0.is_empty() {
            h3 { "Over training seeds" }
            p.soft { "Policies that differ in the seed of their training only; intervals are bootstraps over trainings." }
            (pooled(&report.policies_over_seeds.0))
            (compared(&report.policies_over_seeds.1))
        }
        (films(report, &parts)?)
    })
}

fn tasks(parts: &[&Part<Success>], tasks: &[&str]) -> Markup {
    let mut rows = Vec::new();
    for task in tasks {
        let before = rows.len();
        rows.extend(parts.iter().filter(|part| part.source.task == *task).map(|part| row(part)));
        if rows.len() == before {
            let none = Some(html! { span.none { "no policy" } });
            let mut empty = vec![words(task), none];
            empty.resize(COLUMNS.len(), Some(html! {}));
            rows.push(empty);
        }
    }
    table(&COLUMNS, &rows)
}

fn row(part: &Part<Success>) -> Vec<Option<Markup>> {
    let (source, found) = (&part.source, &part.measured);
    let per_episode = (found.episodes > 0).then(|| found.steps as f64 / found.episodes as f64);
    vec![
        words(&source.task),
        Some(html! { (source.policy) (not_its_own(found)) }),
        Some(rate(found)),
        words(percents(found.interval)),
        words(format!("{} ± {}", number(found.return_mean), number(found.return_std))),
        per_episode.and_then(|steps| words(format!("{steps:.0}"))),
        found.tick.and_then(|tick| words(format!("{:.2} / {:.2}", tick.p50_us / 1e3, tick.p99_us / 1e3))),
    ]
}

/// A success rate in words and drawn.
pub(super) fn rate(found: &Success) -> Markup {
    let rate = found.successes as f64 / found.episodes.max(1) as f64;
    html! {
        span.range-words {
            (range(rate, found.interval)) " " b { (percent(rate)) } " (" (found.successes) " of " (found.episodes) ")"
        }
    }
}

/// A warning where the fallback answered in the policy's place.
fn not_its_own(found: &Success) -> Markup {
    match found.fallback_answers {
        Some(0) => html! {},
        Some(count) => html! { " " span.warn { "(" (count) " answers are the fallback's)" } },
        None => html! { " " span.warn { "(fallback answers unknown)" } },
    }
}

fn films(report: &Report, parts: &[&Part<Success>]) -> Result<Markup, ReportError> {
    if parts.iter().all(|part| part.measured.films.is_empty()) {
        return Ok(html! {});
    }
    let films = parts.iter().map(|part| film_of(report, part)).collect::<Result<Vec<_>, _>>()?;
    Ok(html! {
        h3 { "Films" }
        p.soft {
            "The first episode that was solved and the first that was not, as the camera saw them, 64 × 64 pixels at about the speed \
             of the robot."
        }
        div.films { @for film in films { (film) } }
    })
}

/// The films of one policy.
pub(super) fn film_of(report: &Report, part: &Part<Success>) -> Result<Markup, ReportError> {
    let mut figures = Vec::new();
    for film in &part.measured.films {
        let Some(file) = part.pictures.get(film.picture) else { continue };
        let ended =
            film.solved_at.map_or_else(|| "not solved".to_owned(), |step| format!("solved at step {step}"));
        let source = &part.source;
        let mut title = format!("{}, {}, episode {}", source.task, source.policy, film.episode);
        if source.disturb != UNDISTURBED {
            title = format!("{}: {title}", source.disturb);
        }
        figures.push(html! {
            figure { (report.picture(file, "film", &title)?) figcaption { (title) ": " (ended) } }
        });
    }
    Ok(html! { @for figure in figures { (figure) } })
}
