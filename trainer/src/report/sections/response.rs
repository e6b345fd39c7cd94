use maud::{Markup, html};

use crate::evaluation::{Answer, OtherActions, Share};
use crate::report::html::{Column, nothing, table, words};
use crate::report::{Dynamics, Part, Report, ReportError, UNDISTURBED};

/// What depends on the actions: two action sequences from one start.
pub(super) fn section(report: &Report) -> Result<Markup, ReportError> {
    let parts: Vec<_> = super::dynamics::of(report, UNDISTURBED)
        .into_iter()
        .filter(|part| part.measured.report.response.is_some())
        .collect();
    if parts.is_empty() {
        return Ok(nothing("add --checkpoint DIR and --data DIR with episodes that have masks."));
    }
    let strips = parts.iter().map(|part| strip(report, part)).collect::<Result<Vec<_>, _>>()?;
    Ok(html! {
        p {
            "From the same start and with the same draws, the recorded actions and others are imagined. Where the robot is held still, the \
             scene truly stays as it was last seen, so the true difference is known. The share is the sum of imagined times true difference, \
             divided by the sum of the true one's square: 1 if all that the actions change is imagined to change so, 0 if the picture does \
             not depend on the actions or not in this way. RCWM's environment branch receives the actions through the interaction only."
        }
        (answers(&parts))
        dl { @for answer in Answer::ALL { dt { (title(answer)) } dd { (answer.definition()) } } }
        @for strip in strips { (strip) }
    })
}

fn title(answer: Answer) -> &'static str {
    match answer {
        Answer::Environment => "environment",
        Answer::Elsewhere => "elsewhere",
        Answer::Robot => "robot",
        Answer::Picture => "whole picture",
        Answer::PictureOnRobot => "whole picture on the robot",
    }
}

fn answers(parts: &[&Part<Dynamics>]) -> Markup {
    let columns = [
        Column::Words("task"),
        Column::Words("model"),
        Column::Words("picture"),
        Column::Number("share"),
        Column::Number("95% interval"),
        Column::Number("imagined difference, levels of 255"),
        Column::Number("true difference"),
    ];
    let mut rows = Vec::new();
    for part in parts {
        let Some(response) = &part.measured.report.response else { continue };
        let row = |(answer, found): (&Answer, &Share)| {
            vec![
                words(&part.source.task),
                words(&part.source.model),
                words(title(*answer)),
                found.share.map_or_else(|| words("not known"), |share| words(format!("{share:.3}"))),
                found
                    .interval
                    .map_or_else(|| Some(html! {}), |i| words(format!("{:.3} to {:.3}", i.low, i.high))),
                words(format!("{:.2}", found.imagined * 255.0)),
                words(format!("{:.1}", found.truth * 255.0)),
            ]
        };
        rows.extend(response.answers.iter().map(row));
    }
    html! {
        (table(&columns, &rows))
        p.soft { "Differences are root mean squares; intervals are bootstraps over episodes." }
    }
}

fn strip(report: &Report, part: &Part<Dynamics>) -> Result<Markup, ReportError> {
    let other = part.measured.report.response.as_ref().map_or(OtherActions::Still, |response| response.other);
    let title = format!("{}, {}", part.source.task, part.source.model);
    let mut figures = Vec::new();
    for place in &part.measured.response_pictures {
        let Some(file) = part.pictures.get(*place) else { continue };
        figures.push(html! {
            h3 { (title) }
            figure {
                div.strip { (report.picture(file, "", &title)?) }
                figcaption {
                    "Imagined by the recorded actions, and with the robot " (other.title()) " in place of them; then how far these are apart, \
                     and how far the true picture is from the last one seen."
                }
            }
        });
    }
    Ok(html! { @for figure in figures { (figure) } })
}
