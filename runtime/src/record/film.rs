//! Films (GIF) and film strips (PNG).

use std::fs::File;
use std::io::{BufWriter, Cursor};
use std::path::Path;

use rcwm_models::IMAGE_SIDE;
use rcwm_models::files::write_atomic;

use super::RecordError;
use super::canvas::{Canvas, enlarge};

/// Screen pixels per pixel of the observation in a film.
const FILM_SCALE: usize = 3;
/// The same in a strip.
const STRIP_SCALE: usize = 2;
/// Frames of a strip.
const STRIP_FRAMES: usize = 10;
/// GIF players slow down anything faster than this.
const FRAME_CS_MIN: f64 = 4.0;
/// Colour quantiser: 1 is slowest and best, 30 fastest.
const QUANTISER_SPEED: i32 = 10;

/// Writes frames of `rate_hz` as a film that plays at about real speed, leaving out frames where the rate is too high.
pub(super) fn write_film(path: &Path, frames: &[Canvas], rate_hz: f64) -> Result<(), RecordError> {
    let Some(first) = frames.first() else { return Ok(()) };
    let period_cs = 100.0 / rate_hz;
    let every = (FRAME_CS_MIN / period_cs).ceil().max(1.0) as usize;
    let delay = (period_cs * every as f64).round().clamp(1.0, 1000.0) as u16;
    let side =
        |pixels: usize| u16::try_from(pixels * FILM_SCALE).map_err(|_| RecordError::TooWide { pixels });
    let (width, height) = (side(first.width)?, side(first.height)?);
    let failed =
        |error: gif::EncodingError| RecordError::Film { path: path.to_path_buf(), reason: error.to_string() };
    let file = File::create(path)
        .map_err(|error| RecordError::Film { path: path.to_path_buf(), reason: error.to_string() })?;
    let mut encoder = gif::Encoder::new(BufWriter::new(file), width, height, &[]).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    for frame in frames.iter().step_by(every) {
        encoder.write_frame(&film_frame(frame, width, height, delay)).map_err(failed)?;
    }
    Ok(())
}

/// Colours are chosen on the small picture: a ninth of the work for the same result.
fn film_frame(frame: &Canvas, width: u16, height: u16, delay: u16) -> gif::Frame<'static> {
    let small = |pixels: usize| u16::try_from(pixels).expect("a side that fits when enlarged fits as it is");
    let mut quantised =
        gif::Frame::from_rgb_speed(small(frame.width), small(frame.height), &frame.rgb, QUANTISER_SPEED);
    quantised.buffer = enlarge(&quantised.buffer, frame.width, FILM_SCALE).into();
    (quantised.width, quantised.height, quantised.delay) = (width, height, delay);
    quantised
}

/// Which of `count` frames a strip shows: evenly spread, first and last included.
pub(super) fn strip_choice(count: usize) -> Vec<usize> {
    let shown = count.min(STRIP_FRAMES);
    match shown {
        0 | 1 => (0..shown).collect(),
        _ => (0..shown).map(|i| i * (count - 1) / (shown - 1)).collect(),
    }
}

/// Writes a strip: one column a chosen frame, one row a panel.
pub(super) fn write_strip(path: &Path, columns: &[&[Canvas]]) -> Result<(), RecordError> {
    let rows = columns.first().map_or(0, |column| column.len());
    if rows == 0 {
        return Ok(());
    }
    let cell = IMAGE_SIDE + 1;
    let mut strip = Canvas::new(columns.len() * cell - 1, rows * cell - 1, [255; 3]);
    for (x, column) in columns.iter().enumerate() {
        for (y, panel) in column.iter().enumerate() {
            let pixels = panel.rgb.as_chunks::<3>().0;
            strip.image(x * cell, y * cell, |pixel| pixels[pixel]);
        }
    }
    let strip = strip.enlarged(STRIP_SCALE);
    let mut png = Vec::new();
    let failed = |reason: String| RecordError::Strip { path: path.to_path_buf(), reason };
    image::write_buffer_with_format(
        &mut Cursor::new(&mut png),
        &strip.rgb,
        u32::try_from(strip.width).map_err(|error| failed(error.to_string()))?,
        u32::try_from(strip.height).map_err(|error| failed(error.to_string()))?,
        image::ExtendedColorType::Rgb8,
        image::ImageFormat::Png,
    )
    .map_err(|error| failed(error.to_string()))?;
    Ok(write_atomic(path, &png)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_shows_first_and_last_and_no_frame_twice() {
        assert_eq!(strip_choice(1), [0]);
        assert_eq!(strip_choice(3), [0, 1, 2]);
        let choice = strip_choice(251);
        assert_eq!((choice.len(), choice[0], choice[STRIP_FRAMES - 1]), (STRIP_FRAMES, 0, 250));
        assert!(choice.windows(2).all(|pair| pair[0] < pair[1]));
    }

    #[test]
    fn a_film_has_the_size_and_the_frames_it_should() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.gif");
        let frames: Vec<_> = (0..8).map(|i| Canvas::new(20, 10, [i * 30, 0, 0])).collect();
        write_film(&path, &frames, 40.0).unwrap();
        let mut decoder = gif::DecodeOptions::new().read_info(File::open(&path).unwrap()).unwrap();
        assert_eq!((decoder.width(), decoder.height()), (60, 30));
        let mut shown = 0;
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            // 40 Hz: every second frame, 5 hundredths of a second each.
            assert_eq!(frame.delay, 5);
            shown += 1;
        }
        assert_eq!(shown, 4);
    }
}
