use std::sync::OnceLock;

use image::RgbImage;
use plotters::prelude::*;
use plotters::style::register_font;

use super::{Colour, PlotError};

/// DejaVu Sans, the glyphs that are used; its licence lies beside it.
const FONT: &[u8] = include_bytes!("DejaVuSans-subset.ttf");
/// The name it is known by here.
pub(super) const FAMILY: &str = "sans-serif";

/// Makes the font known, once.
///
/// # Errors
/// [`PlotError::Font`].
pub(super) fn load_font() -> Result<(), PlotError> {
    static KNOWN: OnceLock<bool> = OnceLock::new();
    let known = *KNOWN.get_or_init(|| register_font(FAMILY, FontStyle::Normal, FONT).is_ok());
    if known { Ok(()) } else { Err(PlotError::Font) }
}

/// Writes `text`, `size` pixels high, with its upper left corner at (x, y).
///
/// # Errors
/// [`PlotError::Font`] or [`PlotError::Draw`].
pub fn write_text(
    picture: &mut RgbImage,
    (x, y): (i32, i32),
    size: u32,
    colour: Colour,
    text: &str,
) -> Result<(), PlotError> {
    load_font()?;
    let dimensions = picture.dimensions();
    let area = BitMapBackend::with_buffer(picture, dimensions).into_drawing_area();
    let [r, g, b] = colour;
    let style = (FAMILY, size).into_font().color(&RGBColor(r, g, b));
    let words = Text::new(text, (x, y), style);
    area.draw(&words).and_then(|()| area.present()).map_err(|error| PlotError::Draw(error.to_string()))
}

/// How wide `text` is, in pixels.
///
/// # Errors
/// [`PlotError::Font`] or [`PlotError::Draw`].
pub fn text_width(size: u32, text: &str) -> Result<u32, PlotError> {
    load_font()?;
    let extent = (FAMILY, size).into_font().box_size(text);
    extent.map(|(width, _)| width).map_err(|error| PlotError::Draw(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_drawn_without_any_font_of_the_machine() {
        let mut picture = RgbImage::from_pixel(80, 20, image::Rgb([255; 3]));
        write_text(&mut picture, (2, 2), 14, [0, 0, 0], "KL − 10²").unwrap();
        let dark = picture.pixels().filter(|pixel| pixel.0[0] < 100).count();
        assert!((30..600).contains(&dark), "{dark} dark pixels");
        assert!(text_width(14, "wide word").unwrap() > text_width(14, "w").unwrap());
    }
}
