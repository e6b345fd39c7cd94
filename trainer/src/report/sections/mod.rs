//! What stands on the page, one file a group of sections.

mod attention;
mod disturbances;
mod dynamics;
mod learning;
mod provenance;
mod response;
mod results;
mod seeds;
mod success;

use image::RgbImage;
use maud::{Markup, html};

use super::{Report, ReportError, html as page};
use crate::plots::{self, Panel, PlotError};

/// Pixels of a plot.
const PLOT: (u32, u32) = (560, 360);

/// One section of the page.
pub(super) struct Section {
    /// Where links lead.
    pub(super) id: &'static str,
    pub(super) title: &'static str,
    /// What stands in it.
    pub(super) body: Markup,
}

/// All sections, in their order; those without anything say how to get it.
pub(super) fn all(report: &Report) -> Result<Vec<Section>, ReportError> {
    let section = |id, title, body| Section { id, title, body };
    Ok(vec![
        section("success", "Success", success::section(report)?),
        section("dynamics", "Robot dynamics", dynamics::robot(report)?),
        section("scene", "What else moves", dynamics::scene(report)?),
        section("response", "Response to actions", response::section(report)?),
        section("imagination", "Imagination", dynamics::imagination(report)?),
        section("branches", "Both branches", dynamics::strips(report)?),
        section("attention", "Attention", attention::section(report)?),
        section("disturbances", "Disturbances", disturbances::section(report)?),
        section("comparison", "Comparison of policies", results::section(report)),
        section("learning", "Learning curves", learning::section(report)?),
        section("made", "How it was made", provenance::section(report)),
    ])
}

/// A plot as a figure.
fn plot(panel: &Panel) -> Result<Markup, ReportError> {
    let words = format!("{}: {}", panel.title, panel.x_label);
    Ok(html! { figure { (picture(&plots::draw(std::slice::from_ref(panel), 1, PLOT)?, &words)?) } })
}

fn picture(plot: &RgbImage, words: &str) -> Result<Markup, PlotError> {
    Ok(page::picture(&plots::png(plot)?, "plot", words))
}
