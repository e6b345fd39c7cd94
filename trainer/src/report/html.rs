//! Whatever comes from outside is escaped: `maud` does so unless it is told otherwise, which only the stylesheet is.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use maud::{Markup, PreEscaped, html};

use crate::evaluation::Interval;

const STYLE: &str = include_str!("style.css");

/// A whole page that needs nothing else.
pub(super) fn page(title: &str, body: &Markup) -> String {
    html! {
        (maud::DOCTYPE)
        html lang="en-GB" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                // The page says itself that it loads nothing.
                meta http-equiv="Content-Security-Policy"
                    content="default-src 'none'; img-src data:; style-src 'unsafe-inline'";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body { (body) }
        }
    }
    .into_string()
}

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Column<'a> {
    /// Words, from the left.
    Words(&'a str),
    /// Numbers, from the right.
    Number(&'a str),
}

/// A table. A cell that is missing says so; on a phone every cell names its column.
pub(super) fn table(columns: &[Column<'_>], rows: &[Vec<Option<Markup>>]) -> Markup {
    let parts = |column: &Column<'_>| match column {
        Column::Words(title) => ((*title).to_owned(), None),
        Column::Number(title) => ((*title).to_owned(), Some("number")),
    };
    html! {
        table {
            thead { tr { @for column in columns {
                @let (title, class) = parts(column);
                th class=[class] { (title) }
            } } }
            tbody { @for row in rows { tr { @for (column, cell) in columns.iter().zip(row) {
                @let (title, class) = parts(column);
                td class=[class] data-label=(title) {
                    @match cell {
                        Some(cell) => (cell),
                        None => span.none { "missing" },
                    }
                }
            } } } }
        }
    }
}

/// A picture inside the page.
pub(super) fn picture(bytes: &[u8], class: &str, words: &str) -> Markup {
    let kind = if bytes.starts_with(b"GIF8") { "gif" } else { "png" };
    let source = format!("data:image/{kind};base64,{}", STANDARD.encode(bytes));
    html! { img class=(class) src=(source) alt=(words) loading="lazy"; }
}

/// A rate with its interval, drawn on a rail from 0 to 1.
pub(super) fn range(rate: f64, interval: Interval) -> Markup {
    let x = |share: f64| format!("{:.1}", 2.0 + 96.0 * share.clamp(0.0, 1.0));
    html! {
        svg.range viewBox="0 0 100 10" preserveAspectRatio="none" role="img" aria-label=(percent(rate)) {
            line.rail x1="2" x2="98" y1="5" y2="5" {}
            line.span x1=(x(interval.low)) x2=(x(interval.high)) y1="5" y2="5" {}
            rect.dot x=(format!("{:.1}", 1.0 + 96.0 * rate.clamp(0.0, 1.0))) y="1" width="2" height="8" {}
        }
    }
}

pub(super) fn percent(rate: f64) -> String {
    format!("{:.0}%", 100.0 * rate)
}

/// Both ends of an interval of a rate.
pub(super) fn percents(interval: Interval) -> String {
    format!("{} to {}", percent(interval.low), percent(interval.high))
}

/// A number with about three digits that say something.
pub(super) fn number(value: f64) -> String {
    let digits = match value.abs() {
        size if size >= 100.0 => 0,
        size if size >= 10.0 => 1,
        size if size >= 1.0 || size == 0.0 => 2,
        _ => 3,
    };
    format!("{value:.digits$}")
}

/// What stands where a section has nothing.
pub(super) fn nothing(how: &str) -> Markup {
    html! { p.none { "Not measured: " (how) } }
}

/// Words as a cell.
pub(super) fn words(text: impl AsRef<str>) -> Option<Markup> {
    Some(html! { (text.as_ref()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_from_outside_is_escaped() {
        let evil = "<script>alert(1)</script>\" onload=\"x";
        let table = table(&[Column::Words(evil)], &[vec![words(evil)]]).into_string();
        let picture = picture(b"", "plot", evil).into_string();
        let page = page(evil, &html! { (nothing(evil)) (table) });
        for text in [&table, &picture, &page] {
            assert!(!text.contains("<script") && !text.contains("\" onload="), "{text}");
        }
    }

    #[test]
    fn every_cell_names_its_column_and_a_missing_one_says_so() {
        let columns = [Column::Words("task"), Column::Number("return")];
        let text = table(&columns, &[vec![words("hammer"), None]]).into_string();
        assert!(text.contains(r#"<td data-label="task">hammer</td>"#), "{text}");
        let missing = r#"<td class="number" data-label="return"><span class="none">missing</span></td>"#;
        assert!(text.contains(missing), "{text}");
    }

    #[test]
    fn pictures_are_part_of_the_page() {
        assert!(picture(b"GIF89a", "film", "f").into_string().contains("data:image/gif;base64,R0lGODlh"));
        assert!(picture(b"\x89PNG", "plot", "p").into_string().contains("data:image/png;base64,"));
    }

    #[test]
    fn numbers_are_short() {
        let found = [0.0, 0.01234, 1.234, 56.78, 1234.5].map(number);
        assert_eq!(found, ["0.00", "0.012", "1.23", "56.8", "1234"]);
        assert_eq!(percents(Interval { low: 0.046, high: 1.0 }), "5% to 100%");
    }
}
