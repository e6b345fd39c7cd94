use maud::{Markup, html};

use super::plot;
use crate::report::html::nothing;
use crate::report::{AttentionPart, Part, Report, ReportError};

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
             h. The weights of a column sum to 1. The colours go from the film's least weight to its largest; the mark shows \
             what every row would get if all got the same."
        }
        @for film in films { (film) }
    })
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
            }
        }
        div.plots { @for plot in plots { (plot) } }
    })
}
