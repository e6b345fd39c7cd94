use maud::{Markup, html};

use super::plot;
use crate::report::html::{Column, nothing, table, words};
use crate::report::{AttentionPart, Dynamics, Part, Report, ReportError, UNDISTURBED};

/// What the environment asks of the robot (paper, Fig. 15 and 16).
pub(super) fn section(report: &Report) -> Result<Markup, ReportError> {
    if report.attention.is_empty() {
        return Ok(nothing("add --checkpoint DIR of an RCWM and --data DIR with episodes that have masks."));
    }
    let films = report.attention.iter().map(|part| film(report, part)).collect::<Result<Vec<_>, _>>()?;
    Ok(html! {
        p {
            "The interaction's cross-attention while a trajectory is imagined from its beginning. Columns are the categoricals of the \
             environment's last z, which ask; rows answer: above the categoricals of the robot's predicted z, below the rows made of its \
             h. The weights of a column sum to 1. The colours go from 0 to four times what every row would get if all got the same, in every \
             film: what looks even is even. Marks show the even weight and the film's largest."
        }
        (spread(report))
        @for film in films { (film) }
    })
}

/// How the attention is spread at the imagined states of the windows that robot dynamics are measured on.
fn spread(report: &Report) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("model"),
        Column::Number("states"),
        Column::Number("even weight"),
        Column::Number("smallest to largest"),
        Column::Number("elsewhere than the mean over queries"),
        Column::Number("over states"),
        Column::Number("than even"),
    ];
    let row = |part: &Part<Dynamics>| {
        let found = part.measured.report.attention.as_ref()?;
        Some(vec![
            words(&part.source.task),
            words(&part.source.model),
            words(found.states.to_string()),
            words(format!("{:.4}", found.even)),
            words(format!("{:.4} to {:.4}", found.smallest, found.largest)),
            words(format!("{:.4}", found.over_queries)),
            words(format!("{:.4}", found.over_states)),
            words(format!("{:.4}", found.from_even)),
        ])
    };
    let undisturbed = report.dynamics.iter().filter(|part| part.source.disturb == UNDISTURBED);
    let rows: Vec<_> = undisturbed.filter_map(row).collect();
    html! {
        @if !rows.is_empty() {
            (table(&columns, &rows))
            p.soft {
                "Shares of the attention, from 0 to 1: the part that lies elsewhere than in the mean over the queries of the same state, over \
                 the states of the same query, or than if every row got the same."
            }
        }
    }
}

fn film(report: &Report, part: &Part<AttentionPart>) -> Result<Markup, ReportError> {
    let Some(file) = part.pictures.first() else { return Ok(html! {}) };
    let title = format!("{}, {}", part.source.task, part.source.model);
    let found = &part.measured.attention;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let even = found.rows_of_h as f64 / found.keys.max(1) as f64;
    let imagined = found.share_of_h.len();
    let plots = found.panels().iter().map(plot).collect::<Result<Vec<_>, _>>()?;
    Ok(html! {
        h3 { (title) }
        figure {
            div.strip { (report.picture(file, "", &title)?) }
            figcaption {
                (part.measured.context) " steps seen, " (imagined) " imagined. " (found.rows_of_h) " of " (found.keys)
                " rows are made of h; they get " (format!("{:.3}", mean(&found.share_of_h))) " of the attention ("
                (format!("{even:.3}")) " if all rows got the same)."
                @if part.source.brightest_times_even == 0.0 {
                    " This film is from before colours were the same in every film: they go from its least weight to its largest."
                }
            }
        }
        div.plots { @for plot in plots { (plot) } }
    })
}
