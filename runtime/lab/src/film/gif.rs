//! Films (GIF) and film strips (PNG).

use std::borrow::Cow;
use std::path::Path;

use rcwm_models::files::write_atomic;

use super::FilmError;
use super::canvas::{Canvas, enlarge};
use rcwm_models::picture::write_png;

const STRIP_FRAMES: usize = 10;
/// Shortest time between two frames: enough to follow an arm, at a third of the size of every tick.
const FRAME_CS_MIN: f64 = 7.5;
/// Colours of a film, one less than a palette holds: the last stands for "as before".
const COLOURS: usize = 255;
const AS_BEFORE: u8 = COLOURS as u8;
/// Frames from which the colours are chosen.
const PALETTE_FRAMES: usize = 6;
/// One pixel in this many trains the palette: 1 is slowest and best, 30 fastest.
const PALETTE_SAMPLING: i32 = 10;

/// Writes frames of `rate_hz`, `scale` times as large, as a film that plays at about real speed, leaving out frames where the rate is too
/// high. Where a policy or a robot took over that shows more or less, the film is as large as the largest frame.
pub(super) fn write_film(
    path: &Path,
    frames: &[&Canvas],
    rate_hz: f64,
    scale: usize,
) -> Result<(), FilmError> {
    let largest = |side: fn(&Canvas) -> usize| frames.iter().map(|frame| side(frame)).max();
    let (Some(width), Some(height)) = (largest(|frame| frame.width), largest(|frame| frame.height)) else {
        return Ok(());
    };
    let period_cs = 100.0 / rate_hz;
    let every = (FRAME_CS_MIN / period_cs).ceil().max(1.0) as usize;
    let delay = (period_cs * every as f64).round().clamp(1.0, 1000.0) as u16;
    let side = |pixels: usize| {
        let too_wide = |_| FilmError::Picture {
            path: path.to_path_buf(),
            reason: format!("a picture of {pixels} pixels is too wide for a film"),
        };
        u16::try_from(pixels * scale).map_err(too_wide)
    };
    let screen = (side(width)?, side(height)?);
    let failed = |error: ::gif::EncodingError| FilmError::Picture {
        path: path.to_path_buf(),
        reason: error.to_string(),
    };
    let shown: Vec<_> = frames.iter().step_by(every).map(|frame| frame.grown(width, height)).collect();
    let mut colours = Colours::of(&shown);
    let mut film = Vec::new();
    let mut encoder = ::gif::Encoder::new(&mut film, screen.0, screen.1, &colours.palette).map_err(failed)?;
    encoder.set_repeat(::gif::Repeat::Infinite).map_err(failed)?;
    for frame in shown {
        let buffer = enlarge(&colours.changes(&frame), width, scale).into();
        let frame = ::gif::Frame {
            width: screen.0,
            height: screen.1,
            delay,
            transparent: Some(AS_BEFORE),
            buffer,
            ..::gif::Frame::default()
        };
        encoder.write_frame(&frame).map_err(failed)?;
    }
    // Its end is written when the encoder goes.
    drop(encoder);
    Ok(write_atomic(path, &film)?)
}

/// One palette for the whole film, and what was shown last: most of a scene stands still, and what does not change costs
/// almost nothing.
struct Colours {
    quantiser: color_quant::NeuQuant,
    /// RGB, 256 colours.
    palette: Vec<u8>,
    last: Vec<([u8; 3], u8)>,
}

impl Colours {
    fn of(frames: &[Cow<'_, Canvas>]) -> Self {
        let every = frames.len().div_ceil(PALETTE_FRAMES).max(1);
        let sample: Vec<u8> = frames
            .iter()
            .step_by(every)
            .flat_map(|frame| frame.rgb.as_chunks::<3>().0)
            .flat_map(|[r, g, b]| [*r, *g, *b, u8::MAX])
            .collect();
        let quantiser = color_quant::NeuQuant::new(PALETTE_SAMPLING, COLOURS, &sample);
        let mut palette = quantiser.color_map_rgb();
        palette.resize(3 * (COLOURS + 1), 0);
        Self { quantiser, palette, last: Vec::new() }
    }

    /// Colour numbers of a frame, [`AS_BEFORE`] where the last frame had the same.
    fn changes(&mut self, frame: &Canvas) -> Vec<u8> {
        let pixels = frame.rgb.as_chunks::<3>().0;
        if self.last.len() != pixels.len() {
            self.last = pixels.iter().map(|pixel| (*pixel, number(&self.quantiser, *pixel))).collect();
            return self.last.iter().map(|(_, number)| *number).collect();
        }
        let Self { quantiser, last, .. } = self;
        let change = |(pixel, last): (&[u8; 3], &mut ([u8; 3], u8))| {
            if *pixel == last.0 {
                return AS_BEFORE;
            }
            let before = last.1;
            *last = (*pixel, number(quantiser, *pixel));
            if last.1 == before { AS_BEFORE } else { last.1 }
        };
        pixels.iter().zip(last).map(change).collect()
    }
}

fn number(quantiser: &color_quant::NeuQuant, [r, g, b]: [u8; 3]) -> u8 {
    u8::try_from(quantiser.index_of(&[r, g, b, u8::MAX])).unwrap_or(0)
}

/// Which of `count` frames a strip shows: evenly spread, first and last included.
pub(super) fn strip_choice(count: usize) -> Vec<usize> {
    let shown = count.min(STRIP_FRAMES);
    match shown {
        0 | 1 => (0..shown).collect(),
        _ => (0..shown).map(|i| i * (count - 1) / (shown - 1)).collect(),
    }
}

/// Writes a strip, `scale` times as large: one column a chosen frame, one row a panel.
pub(super) fn write_strip(path: &Path, columns: &[Vec<Canvas>], scale: usize) -> Result<(), FilmError> {
    let rows = columns.iter().map(Vec::len).max().unwrap_or(0);
    let cell = columns.iter().flatten().map(|panel| panel.width + 1).max().unwrap_or(0);
    if rows == 0 {
        return Ok(());
    }
    let mut strip = Canvas::new(columns.len() * cell - 1, rows * cell - 1, [255; 3]);
    for (x, column) in columns.iter().enumerate() {
        for (y, panel) in column.iter().enumerate() {
            strip.paste(x * cell, y * cell, panel);
        }
    }
    let strip = strip.enlarged(scale);
    let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    Ok(write_png(path, [side(strip.width), side(strip.height)], &strip.rgb)?)
}

#[cfg(test)]
mod tests {
    use std::fs::File;

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
    fn what_stands_still_is_left_out_of_the_next_frame() {
        let (red, blue) = ([200, 0, 0], [0, 0, 200]);
        let first = Canvas::new(8, 8, red);
        let mut second = first.clone();
        second.fill(2, 3, 1, 1, blue);
        let mut colours = Colours::of(&[Cow::Borrowed(&first), Cow::Borrowed(&second)]);
        assert!(colours.changes(&first).iter().all(|number| *number != AS_BEFORE));
        let changes = colours.changes(&second);
        assert_eq!(changes.iter().filter(|number| **number != AS_BEFORE).count(), 1);
        assert_ne!(changes[3 * 8 + 2], AS_BEFORE);
    }

    #[test]
    fn a_film_has_the_size_and_the_frames_it_should() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.gif");
        // One of them is of a policy that shows less.
        let width = |i| if i == 3 { 15 } else { 20 };
        let frames: Vec<_> = (0..8).map(|i| Canvas::new(width(i), 10, [i * 30, 0, 0])).collect();
        write_film(&path, &frames.iter().collect::<Vec<_>>(), 40.0, 3).unwrap();
        let mut decoder = ::gif::DecodeOptions::new().read_info(File::open(&path).unwrap()).unwrap();
        assert_eq!((decoder.width(), decoder.height()), (60, 30));
        let mut shown = 0;
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            // 40 Hz: every third frame; 7.5 hundredths of a second, rounded.
            assert_eq!(frame.delay, 8);
            shown += 1;
        }
        assert_eq!(shown, 3);
    }
}
