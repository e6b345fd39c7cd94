use maud::{Markup, html};

use crate::report::html::{Column, nothing, number, percent, percents, range, table, words};
use crate::report::pooled::trainings;
use crate::report::{Pooled, Report, SuccessComparison, UNDISTURBED};

/// RCWM against vanilla, pre-trained against not: whatever the labels say.
pub(super) fn section(report: &Report) -> Markup {
    if report.pooled.is_empty() {
        return nothing(
            "add --results LABEL=FILE with what `evaluate --task ... --json FILE` wrote, once a seed; \
             for example --results \"rcwm, pre-trained=runs/a.json\".",
        );
    }
    html! {
        p {
            "Policies that were measured elsewhere, by label; files of one label are trainings of the same with other seeds. Episodes are \
             pooled within a training; intervals are bootstraps over trainings, of a single one Wilson's over its episodes."
        }
        (pooled(&report.pooled))
        (compared(&report.success_comparisons))
    }
}

/// Trainings taken together.
pub(super) fn pooled(all: &[Pooled]) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("policy"),
        Column::Words("success"),
        Column::Words("95% interval"),
        Column::Words("over"),
        Column::Words("each training"),
        Column::Number("mean ± std of trainings"),
        Column::Number("return"),
    ];
    table(&columns, &all.iter().map(row).collect::<Vec<_>>())
}

/// Sets of trainings against each other.
pub(super) fn compared(all: &[SuccessComparison]) -> Markup {
    if all.is_empty() {
        return html! {};
    }
    let columns = [
        Column::Words("task"),
        Column::Words("policy"),
        Column::Words("against"),
        Column::Number("difference, points"),
        Column::Number("95% interval"),
        Column::Words("over"),
    ];
    let points = |share: f64| format!("{:+.0}", 100.0 * share);
    let row = |found: &SuccessComparison| {
        vec![
            words(task(&found.task, &found.disturb)),
            words(&found.label),
            words(&found.against),
            words(points(found.difference)),
            found.interval.map_or_else(
                || words("none: one training each"),
                |i| words(format!("{} to {}", points(i.low), points(i.high))),
            ),
            words(trainings(found.over)),
        ]
    };
    html! {
        (table(&columns, &all.iter().map(row).collect::<Vec<_>>()))
        p.soft { "Difference of the trainings' mean success rates; trainings of both are drawn in the bootstrap." }
    }
}

fn task(task: &str, disturb: &str) -> String {
    if disturb == UNDISTURBED { task.to_owned() } else { format!("{task}, {disturb}") }
}

fn row(found: &Pooled) -> Vec<Option<Markup>> {
    let rate = found.successes as f64 / found.episodes.max(1) as f64;
    let one_training = || words("one training");
    vec![
        words(task(&found.task, &found.disturb)),
        words(&found.label),
        Some(html! {
            span.range-words {
                (range(rate, found.interval)) " " b { (percent(rate)) } " (" (found.successes) " of " (found.episodes) ")"
            }
        }),
        words(percents(found.interval)),
        words(trainings(found.over)),
        words(found.rates.iter().map(|rate| percent(*rate)).collect::<Vec<_>>().join(", ")),
        found.spread.map_or_else(one_training, |(mean, std)| {
            words(format!("{} ± {:.0}", percent(mean), 100.0 * std))
        }),
        found.return_mean.and_then(|mean| words(number(mean))),
    ]
}
