use maud::{Markup, html};

use crate::report::html::{Column, nothing, number, percent, percents, range, table, words};
use crate::report::results::Pooled;
use crate::report::{Report, UNDISTURBED};

/// RCWM against vanilla, pre-trained against not: whatever the labels say.
pub(super) fn section(report: &Report) -> Markup {
    if report.pooled.is_empty() {
        return nothing(
            "add --results LABEL=FILE with what `evaluate --task ... --json FILE` wrote, once a seed; \
             for example --results \"rcwm, pre-trained=runs/a.json\".",
        );
    }
    let columns = [
        Column::Words("task"),
        Column::Words("policy"),
        Column::Words("success"),
        Column::Words("95% interval"),
        Column::Words("each seed"),
        Column::Number("mean ± std of seeds"),
        Column::Number("return"),
    ];
    let rows: Vec<_> = report.pooled.iter().map(row).collect();
    html! {
        p {
            "Policies that were measured elsewhere, by label; files of one label are seeds of the same. The interval is Wilson's over all \
             their episodes: it does not hold how much seeds differ, which the last columns show."
        }
        (table(&columns, &rows))
    }
}

fn row(found: &Pooled) -> Vec<Option<Markup>> {
    let rate = found.successes as f64 / found.episodes.max(1) as f64;
    let task = if found.disturb == UNDISTURBED {
        found.task.clone()
    } else {
        format!("{}, {}", found.task, found.disturb)
    };
    let one_seed = || words("one seed");
    vec![
        words(task),
        words(&found.label),
        Some(html! {
            span.range-words {
                (range(rate, found.interval)) " " b { (percent(rate)) } " (" (found.successes) " of " (found.episodes) ")"
            }
        }),
        words(percents(found.interval)),
        words(found.rates.iter().map(|rate| percent(*rate)).collect::<Vec<_>>().join(", ")),
        found
            .spread
            .map_or_else(one_seed, |(mean, std)| words(format!("{} ± {:.0}", percent(mean), 100.0 * std))),
        found.return_mean.and_then(|mean| words(number(mean))),
    ]
}
