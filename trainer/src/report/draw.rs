//! The report as a page and as JSON.

use std::path::Path;

use maud::html;
use rcwm_models::files::write_atomic;

use super::{Report, ReportError, html, sections};

impl Report {
    /// Writes `index.html` and `report.json` into the report's folder.
    pub fn write(&self, folder: &Path) -> Result<(), ReportError> {
        let page = self.html()?;
        let mut text = serde_json::to_vec_pretty(self).map_err(ReportError::Json)?;
        text.push(b'\n');
        write_atomic(&folder.join("report.json"), &text)?;
        Ok(write_atomic(&folder.join("index.html"), page.as_bytes())?)
    }

    /// The page.
    ///
    /// # Errors
    /// Those of reading and drawing pictures.
    pub fn html(&self) -> Result<String, ReportError> {
        let sections = sections::all(self)?;
        let body = html! {
            header {
                h1 { "RCWM: what the models can do" }
                p.soft {
                    "Drawn " (self.made.date) " by rcwm-trainer " (self.made.version) " (" (self.made.revision) ") on "
                    (self.made.processor) ", " (self.made.cores) " cores."
                }
                nav { @for section in &sections { a href={ "#" (section.id) } { (section.title) } } }
            }
            main { @for section in &sections {
                section id=(section.id) { h2 { (section.title) } (section.body) }
            } }
        };
        Ok(html::page("RCWM: what the models can do", &body))
    }
}
