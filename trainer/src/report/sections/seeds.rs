use maud::{Markup, html};

use crate::evaluation::{Comparison, Measure, SeedGroup, SeedRow};
use crate::report::Report;
use crate::report::html::{Column, table, words};

/// Sets of models that differ in their training seed only, and these against each other; nothing where there are none.
pub(super) fn section(report: &Report, disturb: &str) -> Markup {
    let parts: Vec<_> = report.over_seeds.iter().filter(|part| part.disturb == disturb).collect();
    let groups: Vec<_> = parts.iter().flat_map(|part| &part.over.groups).collect();
    let compared: Vec<_> = parts.iter().flat_map(|part| &part.over.comparisons).collect();
    let notes: Vec<_> = parts.iter().flat_map(|part| &part.over.notes).collect();
    html! {
        @for note in notes { p.none { (note) } }
        @if !groups.is_empty() {
            h3 { "Over training seeds" }
            (values(&groups))
            (comparisons(&compared))
        }
    }
}

fn values(groups: &[&SeedGroup]) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("script"),
        Column::Words("models"),
        Column::Words("measure"),
        Column::Number("seeds"),
        Column::Number("mean ± std"),
        Column::Number("95% interval of the mean"),
    ];
    let row = |(group, found): (&SeedGroup, &SeedRow)| {
        let scale = scale(found.measure);
        vec![
            words(&found.task),
            words(found.kind.as_deref().unwrap_or("all")),
            words(&group.label),
            words(title(found.measure)),
            words(found.values.len().to_string()),
            match found.values.len() {
                1 => words(format!("{:.3}", found.mean * scale)),
                _ => words(format!("{:.3} ± {:.3}", found.mean * scale, found.std * scale)),
            },
            found.interval.and_then(|i| words(format!("{:.3} to {:.3}", i.low * scale, i.high * scale))),
        ]
    };
    let rows: Vec<_> =
        groups.iter().flat_map(|group| group.rows.iter().map(|found| row((group, found)))).collect();
    table(&columns, &rows)
}

fn comparisons(compared: &[&Comparison]) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("script"),
        Column::Words("measure"),
        Column::Words("models"),
        Column::Words("against"),
        Column::Number("ratio"),
        Column::Number("95% interval"),
        Column::Words("over"),
    ];
    let row = |found: &&Comparison| {
        vec![
            words(&found.task),
            words(found.kind.as_deref().unwrap_or("all")),
            words(title(found.measure)),
            words(&found.model),
            words(&found.against),
            words(format!("{:.3}", found.ratio)),
            found.interval.and_then(|i| words(format!("{:.3} to {:.3}", i.low, i.high))),
            words(found.over.to_string().trim_start_matches("over ")),
        ]
    };
    html! {
        (table(&columns, &compared.iter().map(row).collect::<Vec<_>>()))
        p.soft {
            "Windows are pooled within a training; trainings of both sets are drawn in the bootstrap. Below 1 the first is nearer to the truth."
        }
    }
}

fn scale(measure: Measure) -> f64 {
    if measure == Measure::ChangeError { 1.0 } else { 1e3 }
}

fn title(measure: Measure) -> String {
    let times = if measure == Measure::ChangeError { "" } else { " × 1000" };
    format!("{}{times}", measure.name().replace('_', " "))
}
