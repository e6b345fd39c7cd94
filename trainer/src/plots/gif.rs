use std::path::Path;

use image::RgbImage;

use super::{Colour, PlotError};

/// Colours that are kept exactly: paper and ink of labels and frames.
const EXACT: [Colour; 4] = [super::PAPER, super::INK, super::IMAGINED, [128; 3]];
/// Colours that are chosen from the frames; one number more stands for "as before".
const CHOSEN: usize = 251;
const AS_BEFORE: u8 = u8::MAX;
/// Frames from which the colours are chosen.
const PALETTE_FRAMES: usize = 6;
/// One pixel in this many trains the palette: 1 is slowest and best, 30 fastest.
const PALETTE_SAMPLING: i32 = 20;
/// Levels of a channel that the table of colours tells apart, as bits.
const LEVEL_BITS: u32 = 6;

/// Writes frames of one size as an endless film, each shown for `delay_cs` hundredths of a second.
///
/// # Errors
/// [`PlotError::Film`] or [`PlotError::File`].
pub fn write_gif(frames: &[RgbImage], delay_cs: u16, path: &Path) -> Result<(), PlotError> {
    let Some(first) = frames.first() else { return Ok(()) };
    let failed = |error: gif::EncodingError| PlotError::Film(error.to_string());
    let side = |pixels: u32| {
        u16::try_from(pixels)
            .map_err(|_| PlotError::Film(format!("{pixels} pixels a side, at most 65535 fit")))
    };
    let (width, height) = (side(first.width())?, side(first.height())?);
    let mut colours = Colours::of(frames);
    let mut film = Vec::new();
    let mut encoder = gif::Encoder::new(&mut film, width, height, &colours.palette).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    for frame in frames {
        let buffer = colours.changes(frame).into();
        let transparent = Some(AS_BEFORE);
        let frame =
            gif::Frame { width, height, delay: delay_cs, transparent, buffer, ..gif::Frame::default() };
        encoder.write_frame(&frame).map_err(failed)?;
    }
    // Its end is written when the encoder goes.
    drop(encoder);
    Ok(rcwm_models::files::write_atomic(path, &film)?)
}

/// One palette for the whole film, and what was shown last: what does not change costs almost nothing.
struct Colours {
    quantiser: color_quant::NeuQuant,
    /// RGB, 256 colours.
    palette: Vec<u8>,
    /// Number of every colour that was looked up, by its upper bits.
    known: Vec<Option<u8>>,
    last: Vec<u8>,
}

impl Colours {
    fn of(frames: &[RgbImage]) -> Self {
        let every = frames.len().div_ceil(PALETTE_FRAMES).max(1);
        let pixels = frames.iter().step_by(every).flat_map(|frame| frame.pixels());
        // Paper would take most of the colours.
        let pictured = pixels.filter(|pixel| !EXACT.contains(&pixel.0));
        let sample: Vec<u8> =
            pictured.flat_map(|pixel| [pixel.0[0], pixel.0[1], pixel.0[2], u8::MAX]).collect();
        // The network needs something to learn from.
        let sample = if sample.len() < 4096 { [60, 60, 60, u8::MAX].repeat(1024) } else { sample };
        let quantiser = color_quant::NeuQuant::new(PALETTE_SAMPLING, CHOSEN, &sample);
        let mut palette = quantiser.color_map_rgb();
        palette.extend(EXACT.as_flattened());
        palette.resize(3 * 256, 0);
        Self { quantiser, palette, known: vec![None; 1 << (3 * LEVEL_BITS)], last: Vec::new() }
    }

    /// Colour numbers of a frame, [`AS_BEFORE`] where the last frame had the same.
    fn changes(&mut self, frame: &RgbImage) -> Vec<u8> {
        let numbers: Vec<u8> = frame.pixels().map(|pixel| self.number(pixel.0)).collect();
        let last = std::mem::replace(&mut self.last, numbers);
        if last.len() != self.last.len() {
            return self.last.clone();
        }
        self.last
            .iter()
            .zip(last)
            .map(|(now, before)| if *now == before { AS_BEFORE } else { *now })
            .collect()
    }

    fn number(&mut self, colour: Colour) -> u8 {
        if let Some(index) = EXACT.iter().position(|exact| *exact == colour) {
            return (CHOSEN + index) as u8;
        }
        let place = colour
            .iter()
            .fold(0, |place, level| place << LEVEL_BITS | usize::from(level >> (8 - LEVEL_BITS)));
        *self.known[place].get_or_insert_with(|| {
            let [r, g, b] = colour;
            u8::try_from(self.quantiser.index_of(&[r, g, b, u8::MAX])).unwrap_or(0)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    #[test]
    fn a_film_has_its_frames_and_leaves_out_what_stands_still() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.gif");
        let scene = |moved: u32| {
            RgbImage::from_fn(60, 40, |x, y| match (x, y) {
                (..10, ..10) => image::Rgb(super::super::PAPER),
                _ if x == 20 + moved => image::Rgb([250, 20, 20]),
                _ => image::Rgb([(x * 2) as u8, (y * 3) as u8, 90]),
            })
        };
        let frames: Vec<_> = (0..5).map(scene).collect();
        write_gif(&frames, 8, &path).unwrap();
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::Indexed);
        let mut decoder = options.read_info(File::open(&path).unwrap()).unwrap();
        assert_eq!((decoder.width(), decoder.height()), (60, 40));
        let palette = decoder.palette().unwrap().to_vec();
        let mut shown = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            assert_eq!(frame.delay, 8);
            let colour = |number: u8| palette[3 * usize::from(number)..][..3].to_vec();
            let changed = frame.buffer.iter().filter(|number| **number != AS_BEFORE).count();
            shown.push((changed, colour(frame.buffer[0])));
        }
        assert_eq!(shown.len(), 5);
        assert_eq!(shown[0], (60 * 40, super::super::PAPER.to_vec()));
        assert!(shown[1..].iter().all(|(changed, _)| (1..=120).contains(changed)), "{shown:?}");
    }
}
