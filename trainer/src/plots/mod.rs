//! Pictures for people: panels of lines with bands, films, and text on them. The font is part of the program, so that a machine without
//! fonts draws the same.
//!
//! | file | holds |
//! | --- | --- |
//! | `panel` | one chart: lines, bands, marks |
//! | `axis` | where ticks stand and what they say |
//! | `text` | the font, words on a picture |
//! | `gif` | frames as a film |

mod axis;
mod gif;
mod panel;
mod text;

pub use axis::Scale;
pub use gif::write_gif;
pub use panel::{Band, Line, Mark, Panel, draw};
pub use text::{text_width, write_text};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};

/// Why a plot could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The font that is part of the program is unreadable: a bug.
    #[error("plot: the built-in font is unreadable; this is a bug of this program")]
    Font,
    /// Drawing failed.
    #[error("plot: {0}")]
    Draw(String),
    /// A film could not be packed.
    #[error("film: {0}")]
    Film(String),
    /// The picture could not be packed.
    #[error("plot: {0}")]
    Picture(#[from] image::ImageError),
    /// The file could not be written.
    #[error("plot: {0}")]
    File(#[from] rcwm_models::files::FileError),
}

/// A colour, red, green, blue.
pub type Colour = [u8; 3];

/// Background of pictures.
pub const PAPER: Colour = [255; 3];
/// Words on it.
pub const INK: Colour = [30; 3];
/// The frame around what a model imagined.
pub const IMAGINED: Colour = [240, 140, 20];
/// Colours that are told apart also by those who see no red or green (after Okabe and Ito).
pub const COLOURS: [Colour; 6] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [120, 120, 120]];

/// Writes a picture as PNG, whole or not at all.
///
/// # Errors
/// [`PlotError::Picture`] or [`PlotError::File`].
pub fn write_png(picture: &image::RgbImage, path: &std::path::Path) -> Result<(), PlotError> {
    Ok(rcwm_models::files::write_atomic(path, &png(picture)?)?)
}

/// A picture as the bytes of a PNG file.
///
/// # Errors
/// [`PlotError::Picture`].
pub fn png(picture: &image::RgbImage) -> Result<Vec<u8>, PlotError> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::Adaptive);
    picture.write_with_encoder(encoder)?;
    Ok(bytes)
}
