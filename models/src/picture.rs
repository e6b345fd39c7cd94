//! Pictures as PNG files (feature `pictures`: what runs on a robot draws none).

use std::path::Path;

use crate::files::{FileError, write_atomic};

/// Why a picture was not written.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// It could not be packed.
    #[error("picture: {0}")]
    Png(#[from] png::EncodingError),
    /// The file could not be written.
    #[error(transparent)]
    File(#[from] FileError),
}

/// Writes RGB pixels, rows first.
pub fn write_png(path: &Path, [width, height]: [u32; 2], rgb: &[u8]) -> Result<(), PictureError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    encoder.write_header()?.write_image_data(rgb)?;
    Ok(write_atomic(path, &bytes)?)
}
